"""Scales of losses: the one that losses were made with is found, and a search over decades arrives."""

import math

import pytest
import torch

from torch_zerohess.optim import GaussianProcessSearch
from torch_zerohess.search.gaussian_process.warp import likeliest
from torch_zerohess.surrogates.gaussian_process import Spectra
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
        scaled = size * likeliest(Spectra(points), losses / size, 1.0 / size)
        found += torch.allclose(scaled, losses if unit == math.inf else unit * (losses / unit).asinh())
    assert found >= 8


@pytest.mark.parametrize("made", ["square", "logarithm", "losses"])
def test_the_evidence_finds_the_transform_of_losses_without_noise(made):
    """Losses up to 1 whose square or logarithm, with the shift 0.1, is a sum of waves: found eight of ten times.

    A shift is found if the process gets the waves, scaled, to a tenth of their deviation. Waves stay as they are.
    """
    found = 0
    for seed in range(10):
        generator = torch.Generator().manual_seed(seed)
        points = 4.0 * torch.rand(40, 2, generator=generator, dtype=torch.float64) - 2.0
        waves = torch.sin(1.5 * points).sum(1) + torch.cos(points[:, 0] - points[:, 1])
        smooth = (waves - waves.min()) / (waves.max() - waves.min())
        made_from = {
            "square": (0.01 + 1.2 * smooth).sqrt() - 0.1,
            "logarithm": 0.1 * (2.397895 * smooth).expm1(),
            "losses": smooth,
        }
        scaled = likeliest(Spectra(points), made_from[made], 0.0)
        off = scaled - scaled.mean() - (scaled.std() / smooth.std()) * (smooth - smooth.mean())
        found += torch.equal(scaled, smooth) if made == "losses" else float(off.std()) < 0.1 * float(scaled.std())
    assert found >= 8


@pytest.mark.parametrize("deviation", [1e-200, 5e-324])
def test_losses_that_overflow_over_the_noise_are_not_warped(deviation):
    points = torch.linspace(-1.0, 1.0, 8, dtype=torch.float64)[:, None]
    losses = (points[:, 0] - points[0, 0]).exp() / 10
    losses = losses - losses.min()
    assert torch.equal(likeliest(Spectra(points), losses, deviation), losses)


def searched(loss, x0, sigma, bounds, noise, seed, evaluations):
    """The loss at the best point of a search in noise."""
    generator = torch.Generator().manual_seed(seed)
    search = GaussianProcessSearch(x0, sigma=sigma, bounds=bounds, noise=noise, seed=seed, restarts=100)
    while search.evaluations < evaluations:
        points = search.ask()
        search.tell(loss(points) + noise * torch.randn(len(points), generator=generator, dtype=torch.float64))
    return float(loss(search.x[None]))


@pytest.mark.parametrize("seed", range(3))
def test_a_noisy_loss_over_many_decades_is_followed_to_its_minimum(seed):
    """The fit of a decay: the loss is 72 at the start, up to 6e7 in the box, and below the noise at the end."""
    t = torch.linspace(0.0, 4.0, 12, dtype=torch.float64)

    def loss(x):
        return 50.0 * (x[:, :1] * torch.exp(-x[:, 1:] * t) - 3.0 * torch.exp(-t)).square().sum(1)

    assert searched(loss, vector(4.0, 1.6), 0.3, (-1.0, 15.0), 0.05, seed, 80) < 0.05


@pytest.mark.parametrize("seed", range(2))
def test_a_warped_loss_hides_no_other_basin(seed):
    """The search begins in a basin that ends at 8; the other one ends at 0, between losses that are higher by far."""

    def loss(x):
        near, far = x + vector(1.0, 1.5), x - vector(1.5, 1.0)
        return torch.minimum(8.0 + 20.0 * near.square().sum(1), 50.0 * far.square().sum(1))

    assert searched(loss, vector(-0.8, -1.0), 0.5, (-4.0, 4.0), 0.5, seed, 160) < 1.0


@pytest.mark.parametrize(
    ("f", "most"),
    [(lambda u: u.exp() + (-2.0 * u).exp() - 1.889881574842309, 17), (lambda u: u**2 + u**4, 14)],
    ids=["exponentials", "fourth powers"],
)
def test_a_steep_loss_without_noise_takes_few_evaluations(f, most):
    """The median of five seeds until 1e-4 of the first gap; the minimum is 0. As they are, losses take 20 or more."""
    counts, x0, center = [], vector(-2.5, -2.0), vector(0.4, -0.3)
    for seed in range(5):
        search = GaussianProcessSearch(x0, sigma=2.0, bounds=(-5.0, 5.0), seed=seed, restarts=100)
        while search.value > 1e-4 * float(f(x0 - center).sum()):
            search.tell(f(search.ask() - center).sum(1))
        counts.append(search.evaluations)
    assert sorted(counts)[2] <= most


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_step_decomposes_the_covariances_once(noise, monkeypatch):
    """For the scale of the losses and for the process."""
    counts, honest = [0], torch.linalg.eigh
    search = GaussianProcessSearch(vector(0.5, -0.5), sigma=0.5, bounds=(-2.0, 2.0), noise=noise, seed=0)

    def eigh(matrices):
        counts[-1] += matrices.ndim == 3
        return honest(matrices)

    monkeypatch.setattr(torch.linalg, "eigh", eigh)
    while search.evaluations < 20 and not search.done:
        x = search.ask()
        search.tell((x.square().sum(1) + (5.0 * x).sin().sum(1)).exp())
        counts.append(0)
    assert max(counts) == 1
