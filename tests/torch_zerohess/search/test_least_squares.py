"""Outputs with a sum of squares after them, on problems of Moré, Garbow and Hillstrom."""

import pytest
import torch
from least_squares import PROBLEMS

from torch_zerohess.optim import TrustRegion


@pytest.mark.parametrize("name", PROBLEMS)
def test_the_minima_are_those_of_the_source(name):
    """A start is above the minimum, and residuals [K, m] of two points equal the residuals of each."""
    residuals, start, lowest = PROBLEMS[name]
    both = residuals(torch.stack([start, start + 0.1]))
    torch.testing.assert_close(both[:1], residuals(start[None]))
    assert float(both[0].square().sum()) > lowest


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(("name", "most"), [("powell_singular", 30), ("chebyquad_6", 35)])
def test_evaluations_to_a_hundred_thousandth(name, most, seed):
    """Far below sigma the region is widened again: a faithful long step is followed by a longer one."""
    residuals, start, lowest = PROBLEMS[name]
    sigma = max(0.1 * float(start.abs().max()), 0.05)
    search = TrustRegion(start, sigma=sigma, loss=lambda y: y.square().sum(), seed=seed)
    first = float(residuals(start[None]).square().sum())
    while search.value - lowest > 1e-5 * (first - lowest) and search.evaluations < 200:
        search.tell(residuals(search.ask()))
    assert search.evaluations < most
