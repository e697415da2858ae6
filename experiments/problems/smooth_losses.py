"""Smooth losses of the kinds that users fit: convex ones, and log(1 + u^2), which is convex near its minimum only.

Each kind comes in instances: other random axes, and another minimum within a unit of 0. As a task, a loss is divided by
its first gap, the loss at start 0 minus the minimum. Precisions 10^-0.2 to 1e-8 of that gap are the targets.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.problems.task import Task, Truth, uniform

Function = Callable[[Tensor], Tensor]
SIDE = 5.0
"""The box of a task is [-5, 5]^n."""
SIGMA = 2.0
TARGETS = tuple(float(10.0**k) for k in np.linspace(-0.2, -8.0, 40))
"""Shares of the first gap, the largest first."""
_EXAMPLES = 20
"""Of the regressions, per parameter."""
_PLANES = 5
"""Of log-sum-exp, per parameter."""


def functions(n: int, instance: int) -> dict[str, Function]:
    """Return losses [K, n] -> [K] by name, for one draw of axes, minimum and examples."""
    generator = torch.Generator().manual_seed(instance)
    settings: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    axes = torch.linalg.qr(torch.randn(n, n, **settings))[0]
    place = 2 * torch.rand(n, **settings) - 1
    scale = torch.logspace(0, 2, n, dtype=torch.float64)
    examples = torch.randn(_EXAMPLES * n, n, **settings)
    classes = torch.where(torch.rand(_EXAMPLES * n, **settings) < torch.sigmoid(3 * examples @ place), 1.0, -1.0)
    planes = torch.randn(_PLANES * n, n, **settings)
    counts = (examples @ place / n**0.5).exp()  # means of Poisson's law at the minimum

    def u(z: Tensor) -> Tensor:
        return (z - place) @ axes

    def poisson(z: Tensor) -> Tensor:
        logarithms = z @ examples.mT / n**0.5
        return (logarithms.exp() - counts * logarithms).mean(1)

    return {
        "sphere": lambda z: u(z).square().sum(1),
        "quadratic, condition 100": lambda z: (u(z).square() * scale).sum(1),
        "log cosh, condition 100": lambda z: torch.cosh(u(z) * scale.sqrt()).log().sum(1),
        "logistic regression": lambda z: (
            torch.nn.functional.softplus(-(z @ examples.mT) * classes).mean(1) + 0.01 * z.square().sum(1)
        ),
        "exponentials": lambda z: (u(z).exp() + (-2 * u(z)).exp()).sum(1),
        "pseudo-Huber": lambda z: (1 + 10 * u(z).square()).sqrt().sum(1),
        "quartic": lambda z: (u(z).square() + u(z) ** 4).sum(1),
        "log-sum-exp": lambda z: (u(z) @ planes.mT).logsumexp(1) + 0.1 * u(z).square().sum(1),
        "Poisson regression": poisson,
        "log(1 + u^2)": lambda z: u(z).square().log1p().sum(1),
    }


NAMES = tuple(functions(2, 1))
FUNCTIONS = tuple(range(1, 1 + len(NAMES)))
"""Numbers of the losses, in the order of NAMES."""


def minimizer(function: Function, n: int) -> Tensor:
    """Return the minimum [n] near 0, by Newton's method on derivatives of the loss, with the sizes of eigenvalues."""

    def loss(z: Tensor) -> Tensor:
        return function(z[None])[0]

    x = torch.zeros(n, dtype=torch.float64)
    for _ in range(200):
        curvatures, axes = torch.linalg.eigh(torch.func.hessian(loss)(x))
        step = axes @ ((axes.mT @ torch.func.grad(loss)(x)) / curvatures.abs())
        while float(loss(x - step)) > float(loss(x)) and float(step.norm()) > 1e-12:
            step = 0.5 * step
        if torch.equal(x - step, x):  # all further steps are the same
            break
        x = x - step
    return x


def lowest(function: Function, n: int) -> float:
    """Return the loss at its minimum near 0."""
    return float(function(minimizer(function, n)[None])[0])


def check(n: Sequence[int], numbers: Sequence[int], instances: Sequence[int]) -> None:
    """SystemExit for a number that there is not, or if there are none."""
    if min(n, default=0) < 2:
        raise SystemExit(f"n must be at least 2, got {', '.join(map(str, n)) or 'none'}")
    if not numbers or not set(numbers) <= set(FUNCTIONS):
        raise SystemExit(f"functions must be from 1 to {len(FUNCTIONS)}, got {', '.join(map(str, numbers)) or 'none'}")
    if min(instances, default=0) < 1:
        raise SystemExit(f"instances must be at least 1, got {', '.join(map(str, instances)) or 'none'}")


def task(number: int, instance: int, n: int, evaluations: int) -> Task:
    """Return a loss over its first gap, with uniform starts. A run ends at the finest target."""
    name = NAMES[number - 1]
    function = functions(n, instance)[name]
    minimum = lowest(function, n)
    side = torch.full((n,), SIDE, dtype=torch.float64)
    start = uniform(-side, side)
    gap = float(function(start(0)[None].double())[0]) - minimum

    def loss(x: Tensor) -> Tensor:
        return (function(x.detach().double()) - minimum) / gap

    def error(x: Tensor) -> float:
        return float(loss(x[None]))

    return Task(
        name=f"loss{number}_i{instance}_n{n}",
        title=name,
        parameters="",
        needs="",
        n=n,
        start=start,
        sigma=SIGMA,
        bounds=(-side, side),
        evaluations=evaluations,
        loss=loss,
        truth=Truth(error, lambda x: max(error(x) - TARGETS[-1], 0.0), precision=0.0),
    )
