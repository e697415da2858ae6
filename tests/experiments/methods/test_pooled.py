"""Training from all renders so far: their surrogate, the local entropy, and the tasks that need them."""

import math
from dataclasses import replace

import pytest
import torch
from small import BUMP

from experiments.methods import METHODS
from experiments.methods.pooled import Pooled, Renders, local_entropy
from experiments.problems.network_task import Size
from experiments.problems.tasks import cnn_texture, cnn_wide
from experiments.runs.attempt import attempt

QUICK = {"temperature": 0.1, "steps": 20, "batch": 4, "draws": 4, "rank": 8, "first": 8, "rows": 10}


def trained(task, settings, number=0):
    """Outcome and trial of a run."""
    trials = []
    outcome = attempt(
        task, "pooled", number, lambda trial: (trials.append(trial), METHODS["pooled"](trial, settings))[1]
    )
    assert outcome.status == "stopped", outcome.traceback
    return outcome, trials[0]


def test_losses_of_linear_images_and_where_they_vanish():
    generator = torch.Generator().manual_seed(0)
    slope, offset = torch.randn(6, 40, generator=generator), torch.randn(40, generator=generator)
    points, truth, x = (torch.rand(k, 6, generator=generator) for k in (20, 3, 5))
    renders = Renders(truth @ slope + offset, Pooled(temperature=1.0, surrogate="linear", rank=20))
    renders.add(points[:12], points[:12] @ slope + offset)
    renders.add(points[12:], points[12:] @ slope + offset)
    renders.fit()
    assert renders.evaluations == 20
    expected = (((x @ slope)[None] - (truth @ slope)[[2, 0], None]) ** 2).mean(2)
    torch.testing.assert_close(renders.losses(x, torch.tensor([2, 0])), expected, rtol=1e-3, atol=1e-5)
    torch.testing.assert_close(renders.solutions, truth, rtol=1e-3, atol=1e-3)


def test_losses_between_the_renders_known():
    def images(x):  # a bump at x
        return torch.exp(-0.5 * ((torch.linspace(0, 4, 50) - x) / 0.7) ** 2)

    points = torch.linspace(-1, 5, 25)[:, None]
    targets, x = torch.tensor([[1.0], [2.6]]), torch.tensor([[0.33], [1.7], [3.9]])
    renders = Renders(images(targets), Pooled(temperature=1.0, rank=25))
    renders.add(points, images(points))
    renders.fit()
    assert renders.solutions is None
    expected = (images(x)[None] - images(targets)[:, None]).square().mean(2)
    torch.testing.assert_close(renders.losses(x, torch.arange(2)), expected, rtol=0, atol=2e-3)


@pytest.mark.parametrize("n", [1, 3])
def test_local_entropy_of_a_bowl_against_its_closed_form(n):
    """f = |z - t|^2: E exp(-f / T) is Gaussian, so the gradient of F is 2 sigma^2 (x - t) / (T + 2 sigma^2)."""
    generator = torch.Generator().manual_seed(1)
    sigma, temperature, K = 0.5, 0.4, 200_000
    target = torch.linspace(0.2, 0.6, n, dtype=torch.float64)
    x = torch.zeros(1, n, dtype=torch.float64, requires_grad=True)
    points = sigma * torch.randn(K, n, generator=generator, dtype=torch.float64)
    losses = (points - target).square().sum(1)[None]
    mean = float(target.square().sum()) + n * sigma**2
    value, smoothed = local_entropy(x, points, losses, sigma, temperature / mean)
    (gradient,) = torch.autograd.grad(value, x)
    spread = math.sqrt(float((losses - mean).square().mean()) / K)
    assert abs(smoothed - mean) < 5 * spread
    exact = -2 * sigma**2 * target / (temperature + 2 * sigma**2)
    # The gradient is a self-normalised mean of points; an effective size of K / 20 is a lower bound here.
    assert float((gradient[0] - exact).abs().max()) < 5 * sigma / math.sqrt(K / 20)


def test_points_of_all_centres_serve_each():
    """Two centres: the weights of the mixture make the mean of f around each that of its own Gaussian."""
    generator = torch.Generator().manual_seed(2)
    x = torch.tensor([[0.0], [1.5]], dtype=torch.float64)
    points = (x[:, None] + torch.randn(2, 100_000, 1, generator=generator, dtype=torch.float64)).flatten(0, 1)
    losses = points.T.square().expand(2, -1)
    _, smoothed = local_entropy(x, points, losses, 1.0, 1.0)
    expected = ((0.0 + 1.0) + (1.5**2 + 1.0)) / 2
    assert abs(smoothed - expected) < 5 * 4 / math.sqrt(100_000)


def test_local_entropy_leaves_a_plateau():
    """A narrow valley in a wide plateau that is lower than the slopes: smoothing f ends in the plateau, F does not."""

    def f(z):
        valley = 1 - torch.exp(-0.5 * ((z - 3.0) / 0.2) ** 2)
        return valley * (1.0 - 0.4 * torch.sigmoid(-4 * (z + 1)))

    u = torch.special.ndtri((torch.arange(2001, dtype=torch.float64) + 0.5) / 2001)[:, None]
    ends = {}
    for temperature in (0.05, 1e6):  # exp(-f / T) is nearly linear in f for a large T: F is the mean of f
        x = torch.zeros(1, 1, dtype=torch.float64)
        for sigma in torch.linspace(3, 0.3, 300).tolist():
            points = x + sigma * u
            x.requires_grad_()
            value, _ = local_entropy(x, points, f(points).T, sigma, temperature)
            (slope,) = torch.autograd.grad(value, x)
            x = (x - 0.1 * slope.sign()).detach()
        ends[temperature] = float(x)
    assert abs(ends[0.05] - 3.0) < 0.3
    assert ends[1e6] < -1.0


def test_renders_and_rows_of_a_run():
    _, trial = trained(BUMP, QUICK)
    rows = trial.rows
    assert rows[1].evaluations == QUICK["first"]
    assert len(rows) == 1 + 10 + 1  # every second step, and the last one
    assert rows[-1].evaluations == trial.evaluations == BUMP.evaluations
    assert [k for k, row in enumerate(rows) if row.image_error is not None] == [0, 1, 11]
    assert rows[-1].image_error == BUMP.image_error(trial.encoder)


def test_a_run_repeats_itself():
    first, second = ([replace(row, seconds=0.0) for row in trained(BUMP, QUICK, 3)[1].rows] for _ in range(2))
    assert first == second


def test_a_wide_range_is_learned_where_the_smoothed_loss_has_a_plateau():
    """A stand-in for the mug: a bar that is hidden in a third of the circle. The mean error at the start is 3.6."""

    class Bar(cnn_wide.WideRotation):
        def image(self, x):
            place = (x.reshape(-1, 1, 1, 1) - 6.5) / 12.5
            bar = torch.exp(-0.5 * ((torch.linspace(0, 1, 16) - place) / 0.06) ** 2)
            return bar.expand(-1, 3, 16, 16).contiguous()

    task = Bar(Size(16, 1, 2, evaluations=600, images=256, held_out=32))
    settings = {"temperature": 0.1, "steps": 300, "rank": 64, "draws": 8}
    _, trial = trained(task, settings)
    assert task.parameter_error(trial.encoder) < 0.05 * trial.rows[0].parameter_error


def test_a_texture_is_recovered_from_renders_alone():
    """On a stand-in for the renderer, an image that shows 8 parameters at very different contrasts."""

    class Contrasts(cnn_texture.Texture):
        n = 8

        def encoder(self):
            return torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 8))

        def parameters(self, count, generator, *, held_out):
            return torch.rand(count, 8, generator=generator)

        def image(self, x):
            shown = x.clamp(0, 1).float() * torch.logspace(-2, 0, 8)
            return torch.cat([shown, 0.5 * shown.flip(1)], 1)[:, None, None].expand(-1, 3, 4, -1).contiguous()

    task = Contrasts(Size(4, 1, 2, evaluations=40, images=128, held_out=16))
    settings = {"surrogate": "linear", "temperature": 1.0, "steps": 400, "rate": (1e-2, 1e-3), "rank": 40, "first": 40}
    outcome, trial = trained(task, settings)
    assert outcome.evaluations == 40
    assert task.measured(task.parameter_error(trial.encoder)) > 15.0
