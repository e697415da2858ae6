"""DENSE: a random linear map on which every output depends on every parameter.

Parameters: 300 numbers without a unit and without bounds. Output: A x with A [600, 300] of independent N(0, 1/300).
Solution: from -1 to 1 in equal steps. Starts: uniform in (-2, 2)^300. Loss: mean squared difference of the outputs.
Sigma: 1, of the order of the distance to the solution. Nothing tells one parameter from another, so a sparse Jacobian
has nothing to find.

Both presets are the same.
"""

import math

import torch
from torch import Tensor

from experiments.problems.task import Preset, Task, Truth, least_squares, uniform

N, OUTPUTS = 300, 600


def task(preset: Preset = "fast") -> Task:
    generator = torch.Generator().manual_seed(0)
    matrix = torch.randn(OUTPUTS, N, generator=generator, dtype=torch.float64) / math.sqrt(N)
    solution = torch.linspace(-1.0, 1.0, N, dtype=torch.float64)
    reference = matrix @ solution

    def residuals(output: Tensor) -> Tensor:
        return output - reference

    def loss(x: Tensor) -> Tensor:
        return residuals(x @ matrix.mT).square().mean(1)

    return Task(
        name="dense",
        title="a linear map of 300 parameters to 600 outputs, each of all parameters",
        parameters="300 numbers without a unit, unbounded; starts U(-2, 2)",
        needs="nothing is rendered",
        n=N,
        loss=loss,
        start=uniform(torch.full((N,), -2.0).double(), torch.full((N,), 2.0).double()),
        sigma=1.0,
        evaluations=20_000,
        output=least_squares(lambda x: x @ matrix.mT, residuals),
        truth=Truth(
            lambda x: float(loss(x[None])[0]),
            lambda x: float((x - solution).square().mean()),
            analytic=lambda x, sigma: loss(x[None])[0] + sigma**2 * matrix.square().sum() / OUTPUTS,
        ),
    )
