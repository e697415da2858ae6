"""The soft squares of the BOX tasks against a pixel loop, and the plateau that smoothing gives a slope."""

import math

import pytest
import torch

import torch_zerohess as zh
from experiments.problems import catalogue
from experiments.problems.soft_squares import box2, box10


@pytest.mark.parametrize("task", [box2(), box10()], ids=["BOX2", "BOX10"])
def test_soft_squares(task) -> None:
    side, loss, made = 64, task.loss, catalogue.fitting(task.name.lower())
    assert loss(loss.target[None]).item() == 0
    points = task.start + task.sigma * torch.randn(20, len(task.start), generator=torch.Generator().manual_seed(0))
    pixels = (torch.arange(side) + 0.5).double() / side
    image = torch.zeros(20, side, side).double()
    for p in points.double().clamp(0.1, 0.9).unflatten(1, (-1, 2)).unbind(1):
        x, y = (((pixels - p[:, axis, None]) / 0.1).abs() ** 10 for axis in (0, 1))
        image += (1 - 2 * (y[:, :, None] + x[:, None, :])).clamp(0, 1)
    torch.testing.assert_close(loss.image(points.double()), image.clamp(max=1), rtol=1e-12, atol=1e-12)
    starts = torch.stack([made.start(run) for run in range(1000)])
    assert (starts - task.start).abs().max() <= task.half_range
    assert starts.mean(0).sub(task.start).abs().max() < 5 * task.half_range / math.sqrt(3 * 1000)


def test_box2_is_a_plateau_that_smoothing_gives_a_slope() -> None:
    task = box2()
    x = task.start.clone().requires_grad_()
    flat = task.loss(task.start + torch.linspace(-0.05, 0.05, 9).double()[:, None])
    assert float(flat.std() / flat.mean()) < 0.03
    zh.smooth(task.loss, zh.Smoothing(sigma=task.sigma, samples=2000, seed=0))(x).backward()
    assert (x.grad > 0).all()  # down is towards (0.3, 0.3)
