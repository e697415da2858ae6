"""Training from all renders so far: their surrogate, the local entropy, and the tasks that need them."""

import math

import pytest
import torch

from experiments.methods.pooled import Pooled, Renders, local_entropy
from experiments.methods.training import METHODS, train
from experiments.problems.tasks import cnn5, cnn_texture, cnn_wide
from experiments.problems.tasks.cnn import CnnPreset, CnnTask
from experiments.runs.recorder import Recorder

TASKS = {module.Task.name: module for module in (cnn_wide, cnn5, cnn_texture)}


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

    grid = torch.linspace(-12, 12, 4001, dtype=torch.float64)[:, None]
    losses = f(grid[:, 0])[None]
    x = torch.zeros(1, 1, dtype=torch.float64, requires_grad=True)
    ends = {}
    for temperature in (0.05, 1e6):
        z = x.detach().clone()
        for sigma in torch.linspace(3, 0.3, 300):
            z.requires_grad_()
            logs = -0.5 * ((z - grid[:, 0]) / sigma) ** 2  # a grid has the density of a uniform mixture
            smoothed = (logs.detach().softmax(1) * losses).sum(1)
            F = -(logs - losses / (temperature * smoothed)).logsumexp(1) + logs.logsumexp(1)
            (slope,) = torch.autograd.grad(F.sum() * temperature * smoothed.sum(), z)
            z = (z - 0.1 * slope / slope.abs().clamp_min(1e-9)).detach()
        ends[temperature] = float(z)
    assert abs(ends[0.05] - 3.0) < 0.3
    assert ends[1e6] < -1.0


@pytest.mark.parametrize("name", TASKS)
def test_networks_predict_within_the_ranges(name):
    module = TASKS[name]
    for preset in module.PRESETS.values():
        network = preset.encoder()
        x = network(torch.rand(2, 3, preset.film, preset.film))
        assert x.shape == (2, module.Task.n)
        if name != "cnn_texture":
            assert sum(p.numel() for p in network.parameters()) == {"cnn_wide": 267_745, "cnn5": 268_773}[name]
            assert bool(((network.lower < x) & (x < network.upper)).all())


@pytest.mark.parametrize("name", TASKS)
def test_parameters_can_be_predicted_and_change_the_image(name):
    module = TASKS[name]
    preset = module.Cnn5Preset if name == "cnn5" else type(module.PRESETS["fast"])
    preset = preset(32, 2, 2, (2, 2, 2), evaluations=40, images=6, held_out=3)
    task = module.Task(preset, 0, preset.scene("scalar_rgb", 1))
    (images, x), (_, unseen) = task.training, task.held_out
    assert images.shape == (6, 3, 32, 32)
    assert x.shape == (6, task.n)
    assert not torch.isclose(x[:, None], unseen[None]).all(2).any()
    assert float(task.loss(x, images).max()) < 1e-12
    away = x + 0.5 * task.sigma[0] * torch.randn(x.shape, generator=torch.Generator().manual_seed(0))
    assert float(task.loss(away, images).min()) > 1e-6
    assert task.evaluations == 2 * len(x)
    assert task.pictures(images, x).shape[:2] == (6, 32)


def test_a_wide_range_is_learned_where_the_smoothed_loss_has_a_plateau():
    """A stand-in for the mug: a bar that is hidden in a third of the circle. The mean error at the start is 3.6."""

    class Bar(CnnTask):
        angles = cnn_wide.ANGLES
        sigma = (3.0, 0.1)
        pooled = Pooled(temperature=0.1, steps=300, rank=64, draws=8)

        def render(self, x):
            place = (x.reshape(-1, 1, 1, 1) - 6.5) / 12.5
            bar = torch.exp(-0.5 * ((torch.linspace(0, 1, 16) - place) / 0.06) ** 2)
            return bar.expand(-1, 3, 16, 16).contiguous()

    preset = cnn_wide.WidePreset(16, 1, 2, (2, 2, 2), evaluations=600, images=256, held_out=32)
    task, recorder = Bar(preset, 0, None), Recorder("cnn", "pooled", 0)
    encoder = train(task, METHODS["pooled"], 0, recorder)
    assert task.parameter_error(encoder) < 0.05 * recorder.rows[0].parameter_error


def test_a_texture_is_recovered_from_renders_alone():
    """On a stand-in for the renderer, an image that shows 8 parameters at very different contrasts."""

    class Contrasts(cnn_texture.Task):
        n = 8
        pooled = Pooled(surrogate="linear", temperature=1.0, steps=400, rate=(1e-2, 1e-3), rank=40, first=40)

        def parameters(self, count, generator, *, held_out):
            return torch.rand(count, 8, generator=generator)

        def render(self, x):
            shown = x.clamp(0, 1).float() * torch.logspace(-2, 0, 8)
            return torch.cat([shown, 0.5 * shown.flip(1)], 1)[:, None, None].expand(-1, 3, 4, -1).contiguous()

    class Preset(CnnPreset):
        def encoder(self):
            return torch.nn.Sequential(torch.nn.Flatten(), torch.nn.Linear(192, 8))

    task = Contrasts(Preset(4, 1, 2, (1, 1, 1), evaluations=40, images=128, held_out=16), 0, None)
    encoder = train(task, METHODS["pooled"], 0, Recorder("cnn_texture", "pooled", 0))
    assert task.evaluations == 40
    assert task.measured(task.parameter_error(encoder)) > 15.0
