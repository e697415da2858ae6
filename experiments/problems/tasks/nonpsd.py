"""NONPSD: the minimum of a negated Gaussian, whose Hessian is indefinite or negative wherever one is far from it.

Parameters: x0 and x1 in [-3, 3]. Loss: -N(x; 0, s1^2 I), the negated density of the normal distribution with s1 = 1;
its convolution with N(0, s2^2 I) is -N(0, s3^2 I) with s3^2 = s1^2 + s2^2. The solution is 0. There is no image: the
image error is loss(x) - loss(solution). Beyond |x| = s1 the Hessian has a negative eigenvalue: a Newton step
without modification goes away from the solution.

Starts: runs 0 to 399 are the points of a 20x20 grid over [-3, 3]^2, corners included, in an order that is random but
fixed, so that 400 runs cover the square and the first 20 are spread over it. Sigma: 1.

Runs should end within 0.01 of the solution, which is more than the 99.9 % that other tasks are measured at.
Both presets are the same.
"""

import math

import torch
from torch import Tensor

from experiments.problems.task import Preset, Task, Truth, uniform

S1 = 1.0
GRID = 20
DISTANCE = 0.01


def gaussian(x: Tensor, width: float) -> Tensor:
    """-N(x; 0, width^2 I) for x [*batch, 2]: [*batch]."""
    return -torch.exp(-0.5 * x.square().sum(-1) / width**2) / (2 * math.pi * width**2)


def loss(x: Tensor) -> Tensor:
    """[K, 2] -> [K]."""
    return gaussian(x, S1)


def start(run: int) -> Tensor:
    """Return a point of the grid for runs below 400, else a random one."""
    if run >= GRID**2:
        return uniform(torch.full((2,), -3.0).double(), torch.full((2,), 3.0).double())(run)
    order = torch.randperm(GRID**2, generator=torch.Generator().manual_seed(0))
    axis = torch.linspace(-3, 3, GRID, dtype=torch.float64)
    return torch.cartesian_prod(axis, axis)[order[run]]


def task(preset: Preset = "fast") -> Task:
    least = loss(torch.zeros(1, 2).double())[0]
    return Task(
        name="nonpsd",
        title="the minimum of a negated Gaussian, from where its Hessian is indefinite",
        parameters="x0, x1 without a unit, -3 to 3; starts on a 20x20 grid, solution (0, 0)",
        needs="nothing is rendered",
        n=2,
        loss=loss,
        start=start,
        sigma=1.0,
        evaluations=50_000,
        bounds=(torch.full((2,), -3.0).double(), torch.full((2,), 3.0).double()),
        truth=Truth(
            lambda x: float(loss(x[None])[0] - least),
            lambda x: float(x.square().mean()),
            analytic=lambda x, sigma: gaussian(x, math.hypot(S1, sigma)),
            precision=DISTANCE**2 / 2,
        ),
    )
