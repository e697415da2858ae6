"""The lowest of many candidates against minima that are known."""

import pytest
import torch
from searches import waves

from torch_zerohess.search.gaussian_process.candidates import is_known, least_known, lowest
from torch_zerohess.surrogates.gaussian_process import GaussianProcess
from truths import vector

LOWER, UPPER = vector(-3.0, -2.0), vector(2.0, 3.0)
SEEDS = 60


def searched(model, best):
    """The candidates [60, n] that are found from different seeds."""
    seeds = (torch.Generator().manual_seed(seed) for seed in range(SEEDS))
    return torch.stack([lowest(model, best, LOWER, UPPER, seed) for seed in seeds])


@pytest.mark.parametrize(("size", "within"), [(1.0, 0.018), (0.1, 0.08), (0.02, 0.18)])
def test_a_minimum_near_the_best_point_is_found_at_every_scale(size, within):
    """A paraboloid at a distance, beyond which everything is the same: nine of ten end this close to its minimum.

    Distances are relative to the size of the paraboloid.
    """
    minimum = vector(0.5, 0.3)
    best = minimum + size * vector(0.6, -0.6)

    def model(x):
        return ((x - minimum).norm(dim=1) / size).clamp(max=1.0)

    distance = (searched(model, best) - minimum).norm(dim=1) / size
    assert float(distance.quantile(0.9)) < within


def test_a_minimum_far_from_the_best_point_is_found():
    """A cone that takes a fifth of the box, four away from the best point."""
    minimum = vector(1.0, 2.0)

    def model(x):
        return (x - minimum).norm(dim=1).clamp(max=1.2)

    distance = (searched(model, vector(-2.5, -1.5)) - minimum).norm(dim=1)
    assert float(distance.quantile(0.9)) < 0.03


def test_candidates_are_in_the_box():
    for corner in (LOWER, UPPER):
        found = searched(lambda x: (x - 2 * corner).norm(dim=1), corner)  # noqa: B023
        assert torch.equal(found, corner.expand(SEEDS, 2))


def test_the_least_known_point_is_far_from_those_that_are_known():
    """All known points are in the lower half of the box."""
    generator = torch.Generator().manual_seed(0)
    points = LOWER + (UPPER - LOWER) * torch.rand(20, 2, generator=generator, dtype=torch.float64) * vector(1.0, 0.5)
    process = GaussianProcess.fit(points, waves(points))
    apart = []
    for _ in range(SEEDS):
        x = least_known(process, LOWER, UPPER, generator)
        assert bool(((x >= LOWER) & (x <= UPPER)).all())
        apart.append(float((points - x).norm(dim=1).min()))
    uniform = LOWER + (UPPER - LOWER) * torch.rand(1000, 2, generator=generator, dtype=torch.float64)
    usual = torch.cdist(uniform, points).min(1).values
    assert min(apart) > float(usual.median())


def test_a_point_is_known_within_a_ten_thousandth():
    points = torch.stack([LOWER, vector(0.5, 0.3), UPPER])
    process = GaussianProcess.fit(points, waves(points))
    assert is_known(process, points[1] + vector(0.0, 0.9e-4))
    assert not is_known(process, points[1] + vector(0.0, 1.1e-4))


def test_with_many_parameters_each_is_searched_along_its_axis():
    """A sum of narrow wells of ten parameters: nine of them are where they were, and one is found."""
    places, n = torch.linspace(-0.8, 0.8, 10, dtype=torch.float64), 10

    def model(x):
        return (10.0 * (x - places).abs()).clamp(max=1.0).sum(1)

    lower, best = torch.full((n,), -1.0, dtype=torch.float64), places.clone()
    best[3] = 0.9
    found = [
        float(model(lowest(model, best, lower, -lower, torch.Generator().manual_seed(seed))[None]))
        for seed in range(SEEDS)
    ]
    assert sum(found) / SEEDS < 0.7  # 1 at the best point
