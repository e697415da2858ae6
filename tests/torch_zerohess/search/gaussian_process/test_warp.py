"""The warp of noisy losses: the scale that the losses were made with is found, and a search over decades arrives."""

import math

import pytest
import torch

from torch_zerohess.optim import GaussianProcessSearch
from torch_zerohess.search.gaussian_process.warp import warped
from truths import vector


@pytest.mark.parametrize("unit", [math.inf, 300.0, 30.0])
def test_the_evidence_finds_the_scale_on_which_losses_are_smooth(unit):
    """Losses v for which u asinh(v / u) is a sum of waves: eight of ten times they are warped by this u."""
    found = 0
    for seed in range(10):
        generator = torch.Generator().manual_seed(seed)
        points = 4.0 * torch.rand(60, 2, generator=generator, dtype=torch.float64) - 2.0
        waves = torch.sin(1.5 * points).sum(1) + torch.cos(points[:, 0] - points[:, 1])
        smooth = 600.0 * (waves - waves.min())
        losses = smooth if unit == math.inf else unit * (smooth / unit).sinh()
        losses = losses + torch.randn(60, generator=generator, dtype=torch.float64)  # noise of standard deviation 1
        losses = losses - losses.min()
        size = float(losses.max())
        scaled = size * warped(points, losses / size, 1.0 / size, ("joint",))
        found += torch.allclose(scaled, losses if unit == math.inf else unit * (losses / unit).asinh())
    assert found >= 8


@pytest.mark.parametrize("deviation", [1e-200, 5e-324])
def test_losses_that_overflow_over_the_noise_are_not_warped(deviation):
    points = torch.linspace(-1.0, 1.0, 8, dtype=torch.float64)[:, None]
    losses = (points[:, 0] - points[0, 0]).exp() / 10
    losses = losses - losses.min()
    assert torch.equal(warped(points, losses, deviation, ("joint",)), losses)


@pytest.mark.parametrize("seed", range(3))
def test_a_noisy_loss_over_many_decades_is_followed_to_its_minimum(seed):
    """The fit of a decay: the loss is 72 at the start, up to 6e7 in the box, and below the noise at the end."""
    generator, t = torch.Generator().manual_seed(seed), torch.linspace(0.0, 4.0, 12, dtype=torch.float64)

    def loss(x):
        return 50.0 * (x[:, :1] * torch.exp(-x[:, 1:] * t) - 3.0 * torch.exp(-t)).square().sum(1)

    search = GaussianProcessSearch(
        vector(4.0, 1.6), sigma=0.3, bounds=(-1.0, 15.0), noise=0.05, seed=seed, restarts=100
    )
    while search.evaluations < 80:
        points = search.ask()
        search.tell(loss(points) + 0.05 * torch.randn(len(points), generator=generator, dtype=torch.float64))
    assert float(loss(search.x[None])) < 0.05
