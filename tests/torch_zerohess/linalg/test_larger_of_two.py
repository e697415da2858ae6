"""The minimum of the larger of two quadratics in a region, against SciPy."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch import Tensor

from torch_zerohess.linalg.larger_of_two import least_of_larger, share_of_shortest, two_values
from torch_zerohess.linalg.subproblem import ball_step


def random(seed: int, n: int, *, convex: bool) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    m = torch.randn(2, n + 1, n + 1, generator=generator, dtype=torch.float64)
    m = m + m.mT
    if convex:
        root = torch.randn(2, n, n, generator=generator, dtype=torch.float64)
        m[:, 1:, 1:] = root @ root.mT
    m[:, 0, 0] *= 0.1
    return m


def in_ball(matrices: Tensor) -> Tensor:
    return least_of_larger(matrices, lambda gradient, hessian: ball_step(gradient, hessian, 1.0))


def is_minimum_of_one(matrices: Tensor, s: Tensor) -> bool:
    return any(torch.equal(s, ball_step(one[1:, 0], one[1:, 1:], 1.0)) for one in matrices)


def larger(matrices: Tensor, s: Tensor) -> float:
    return float(two_values(matrices, s[None]).amax())


def by_scipy(matrices: Tensor) -> float:
    """Minimise t with q_1 <= t, q_2 <= t and |s| <= 1."""
    m, n = matrices.numpy(), matrices.shape[1] - 1

    def rest(z: np.ndarray) -> np.ndarray:
        one = np.concatenate([[1.0], z[:n]])
        return np.concatenate([z[n] - 0.5 * np.einsum("i,pij,j->p", one, m, one), [1.0 - z[:n] @ z[:n]]])

    constraint = {"type": "ineq", "fun": rest}
    options = {"ftol": 1e-14, "maxiter": 500}
    start = np.concatenate([np.zeros(n), [larger(matrices, torch.zeros(n).double())]])
    return float(minimize(lambda z: z[n], start, method="SLSQP", constraints=constraint, options=options).x[n])


@pytest.mark.parametrize("n", [1, 2, 5])
def test_the_minimum_of_convex_quadratics(n: int) -> None:
    alone = []
    for seed in range(20):
        matrices = random(seed, n, convex=True)
        s = in_ball(matrices)
        assert float(s.norm()) <= 1 + 1e-9
        assert larger(matrices, s) == pytest.approx(by_scipy(matrices), abs=1e-7)
        alone.append(is_minimum_of_one(matrices, s))
    assert not all(alone)


@pytest.mark.parametrize(("steep", "swapped"), [(1.0, False), (1e4, False), (100.0, True)])
def test_where_they_are_equal_they_are_exactly_so(steep: float, swapped: bool) -> None:
    """Also where one of them is much steeper than the other."""
    found = 0
    for seed in range(20):
        matrices = random(seed, 5, convex=True)
        matrices[1] *= steep
        matrices = matrices.flip(0) if swapped else matrices
        s = in_ball(matrices)
        first, second = two_values(matrices, s[None])[:, 0].tolist()
        if not is_minimum_of_one(matrices, s):
            found += 1
            assert first == pytest.approx(second, rel=1e-7)
    assert found >= 5


def test_the_larger_one_is_minimised_alone_where_it_is_larger_at_its_minimum() -> None:
    matrices = random(0, 3, convex=True)
    matrices[1] = matrices[0]
    matrices[1, 0, 0] += 1.0
    expected = ball_step(matrices[1, 1:, 0], matrices[1, 1:, 1:], 1.0)
    assert torch.equal(in_ball(matrices), expected)
    assert torch.equal(in_ball(matrices.flip(0)), expected)


def test_a_steep_side() -> None:
    """The share of the steep quadratic is a millionth, and the minimum as exact as without it."""
    slopes = torch.tensor([[0.0, 1.0, 0.0], [-3e5, -1e6, 0.0]]).double()
    matrices = torch.zeros(2, 3, 3).double()
    matrices[:, 0], matrices[:, 1:, 0] = slopes, slopes[:, 1:]
    matrices[:, 1:, 1:] = torch.eye(2).double()
    assert in_ball(matrices).tolist() == pytest.approx([-0.15, 0.0], abs=1e-5)
    assert share_of_shortest(*slopes[:, 1:]) == pytest.approx(1e-6, rel=1e-3)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_concave_quadratics(n: int) -> None:
    """The end is no worse than the minimum of either, and than what lies between the sides of a jump."""
    for seed in range(40):
        matrices = random(seed, n, convex=False)
        found = larger(matrices, in_ball(matrices))
        assert found <= larger(matrices, torch.zeros(n).double()) + 1e-9
        ends = [ball_step(one[1:, 0], one[1:, 1:], 1.0) for one in matrices]
        assert found <= min(larger(matrices, end) for end in ends) + 1e-9


@pytest.mark.parametrize(
    ("second", "share"),
    [([-1.0, 0.0], 0.5), ([-3.0, 0.0], 0.25), ([0.0, 1.0], 0.5), ([2.0, 0.0], 0.0), ([0.5, 0.0], 1.0)],
)
def test_the_share_of_the_shortest_gradient(second: list[float], share: float) -> None:
    assert share_of_shortest(torch.tensor([1.0, 0.0]), torch.tensor(second)) == pytest.approx(share)


@pytest.mark.parametrize("size", [1e-300, 1.0, 1e300])
def test_the_size_of_gradients_does_not_matter(size: float) -> None:
    assert share_of_shortest(size * torch.tensor([1.0, 0.0]).double(), torch.zeros(2).double()) == 1.0
    assert share_of_shortest(size * torch.ones(2).double(), -size * torch.ones(2).double()) == pytest.approx(0.5)


def test_equal_gradients_have_no_share() -> None:
    assert share_of_shortest(torch.ones(2), torch.ones(2)) == 0.0


def test_values() -> None:
    matrices, s = random(0, 3, convex=False), torch.randn(4, 3, dtype=torch.float64)
    for k, one in enumerate(matrices):
        expected = 0.5 * one[0, 0] + s @ one[1:, 0] + 0.5 * ((s @ one[1:, 1:]) * s).sum(1)
        assert torch.allclose(two_values(matrices, s)[k], expected)


def test_concave_quadratics_have_a_minimum_between_the_sides_of_a_jump() -> None:
    """At s = -1 and 1 one of them is 1, at 0 both are 0.5: s(w) jumps from one end to the other."""
    matrices = torch.tensor([[[1.0, 0.5], [0.5, 0.0]], [[1.0, -0.5], [-0.5, 0.0]]]).double()
    matrices[:, 1, 1] = -1e-3
    assert larger(matrices, in_ball(matrices)) == pytest.approx(0.5, abs=1e-3)
