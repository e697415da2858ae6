"""Random directions, and points of a search that would lie outside of its box."""

import torch

from torch_zerohess.search.protocol.random_points import orthonormal, reflect
from truths import vector


def test_points_outside_of_a_box_are_mirrored_into_it_or_moved_to_its_sides() -> None:
    z = torch.stack([vector(-0.2, 0.4), vector(1.3, 0.4), vector(2.5, 0.4), vector(0.5, -9.0)])
    found = reflect(z, vector(0.0, 0.0), vector(1.0, 0.5))
    expected = torch.stack([vector(0.2, 0.4), vector(0.7, 0.4), vector(0.0, 0.4), vector(0.5, 0.0)])
    torch.testing.assert_close(found, expected)


def test_orthonormal_directions_have_no_preferred_side() -> None:
    """Entries of 400 bases have mean 0 and mean square 1/n: ten comparisons of a false-alarm rate of 6e-7 each."""
    generator = torch.Generator().manual_seed(0)
    for n, k in ((1, 1), (2, 2), (5, 3)):
        bases = torch.stack([orthonormal(torch.randn(n, k, generator=generator).double()) for _ in range(400)])
        torch.testing.assert_close(bases.mT @ bases, torch.eye(k, dtype=torch.float64).expand(400, k, k))
        error = bases.std(0) / 400**0.5
        assert bool((bases.mean(0).abs() < 5 * error).all())
