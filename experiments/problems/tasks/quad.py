"""QUAD: a quadratic of two parameters, the case that every second-order method must solve in a few steps.

Parameters: x0 and x1, without a unit and without bounds. Loss: 5 x0^2 + 5 x1^2 + 7.5 x0 x1, whose Hessian has the
eigenvalues 2.5 and 17.5. Starts: uniform in (800, 1000)^2. The solution is 0. There is no image: the image error is
the loss. Sigma: 500, of the order of the distance to the solution; the source smooths with 1 and less.

Both presets are the same.
"""

import torch
from torch import Tensor

from experiments.problems.task import Preset, Task, Truth, uniform

A, B, C = 5.0, 5.0, 7.5


def loss(x: Tensor) -> Tensor:
    """[K, 2] -> [K]."""
    return A * x[:, 0] ** 2 + B * x[:, 1] ** 2 + C * x[:, 0] * x[:, 1]


def analytic(x: Tensor, sigma: float) -> Tensor:
    """Convolution of the loss with a Gaussian at x [2]: half the trace of the Hessian times sigma^2 is added."""
    return loss(x[None])[0] + (A + B) * sigma**2


def task(preset: Preset = "fast") -> Task:
    return Task(
        name="quad",
        title="the minimum of a quadratic",
        parameters="x0, x1: numbers without a unit, unbounded; starts U(800, 1000)^2, solution (0, 0)",
        needs="nothing is rendered",
        n=2,
        loss=loss,
        start=uniform(torch.full((2,), 800.0).double(), torch.full((2,), 1000.0).double()),
        sigma=500.0,
        evaluations=100_000,
        truth=Truth(lambda x: float(loss(x[None])[0]), lambda x: float(x.square().mean()), analytic),
    )
