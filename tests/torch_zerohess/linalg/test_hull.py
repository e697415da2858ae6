"""The shortest vector of a convex hull."""

import torch

from torch_zerohess.linalg.hull import shortest, shortest_between


def test_the_shortest_vector_of_a_hull_is_a_corner_a_point_of_a_side_or_zero() -> None:
    corner = torch.tensor([[1.0, 0.0], [2.0, 1.0], [2.0, -1.0]], dtype=torch.float64)
    assert torch.allclose(shortest(corner), corner[0], atol=1e-9)
    side = torch.tensor([[1.0, 3.0], [1.0, -1.0], [4.0, 0.0]], dtype=torch.float64)
    assert torch.allclose(shortest(side), torch.tensor([1.0, 0.0], dtype=torch.float64), atol=1e-9)
    around = torch.tensor([[1.0, 0.0], [-1.0, 1.0], [-1.0, -1.0]], dtype=torch.float64)
    assert float(shortest(around).norm()) < 1e-9
    assert torch.equal(shortest(corner[1:2]), corner[1])
    assert float(shortest(torch.zeros(3, 2, dtype=torch.float64)).norm()) == 0.0


def test_lengths_may_differ_by_ten_orders() -> None:
    gentle, normal = torch.tensor([[1.0, 1.0], [1.0, 0.5]], dtype=torch.float64)
    for ratio in (1e2, 1e6, 1e10):
        found = shortest(torch.stack([gentle, gentle - ratio * normal, gentle + 0.1 * normal]))
        assert torch.allclose(found, torch.tensor([-0.2, 0.4], dtype=torch.float64), rtol=1e-4)


def test_it_makes_no_acute_angle_with_what_is_shorter_along_it() -> None:
    """The condition of optimality: v g >= |v|^2 for every vector g of the hull."""
    generator = torch.Generator().manual_seed(0)
    for m, n in ((4, 6), (12, 6), (40, 10)):
        vectors = torch.randn(m, n, generator=generator, dtype=torch.float64) + 0.8
        found = shortest(vectors)
        assert float((vectors @ found).min()) >= float(found @ found) - 1e-3 * float(found.norm())


def test_the_scale_of_the_vectors_does_not_matter() -> None:
    """Also where squares of their lengths are zero or infinite."""
    vectors = torch.randn(12, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64) + 0.8
    for scale in (2.0**-600, 2.0**600):
        assert torch.equal(shortest(scale * vectors), scale * shortest(vectors))


def test_between_two_hulls_no_other_vector_is_shorter() -> None:
    """The conditions of optimality: no end is nearer along the vector, and no origin farther."""
    generator = torch.Generator().manual_seed(0)
    for m, n in ((3, 2), (12, 4), (40, 10)):
        origins, ends = torch.randn(2, m, n, generator=generator, dtype=torch.float64)
        ends[:, 0] += 8.0
        found = shortest_between(origins, ends)
        assert float((ends @ found).min() - (origins @ found).max()) >= (1.0 - 1e-5) * float(found @ found)
        assert float(shortest_between(origins, origins.flip(0)).norm()) < 1e-6
