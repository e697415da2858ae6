"""Outputs with a sum of squares after them, on problems of Moré, Garbow and Hillstrom (1981) whose minimum is 0."""

import pytest
import torch

from torch_zerohess.optim import TrustRegion
from truths import vector


def powell_singular(x):
    a, b, c, d = x.mT
    return torch.stack([a + 10 * b, 5**0.5 * (c - d), (b - 2 * c) ** 2, 10**0.5 * (a - d) ** 2], 1)


def chebyquad(x):
    """Means of the shifted Chebyshev polynomials of degree 1 to n, less their integrals: [K, n] -> [K, n]."""
    n = x.shape[1]
    y = 2 * x - 1
    before, now, rows = torch.ones_like(y), y, []
    for i in range(1, n + 1):
        rows.append(now.mean(1) + (1 / (i * i - 1) if i % 2 == 0 else 0.0))
        before, now = now, 2 * y * now - before
    return torch.stack(rows, 1)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    ("residuals", "start", "most"),
    [
        (powell_singular, vector(3.0, -1.0, 0.0, 1.0), 30),
        (chebyquad, torch.arange(1, 7, dtype=torch.float64) / 7, 35),
    ],
    ids=["powell_singular", "chebyquad_6"],
)
def test_evaluations_to_a_hundred_thousandth(residuals, start, most, seed):
    """The first sigma is a tenth of the distance to the solution, or less: the region has to grow."""
    sigma = max(0.1 * float(start.abs().max()), 0.05)
    search = TrustRegion(start, sigma=sigma, loss=lambda y: y.square().sum(), seed=seed)
    first = float(residuals(start[None]).square().sum())
    while search.value > 1e-5 * first and search.evaluations < 200:
        search.tell(residuals(search.ask()))
    assert search.evaluations < most
