"""The 53 least-squares problems of More and Wild 2009, "Benchmarking derivative-free optimization algorithms".

22 functions with 2 to 12 parameters and 2 to 65 residuals. Some start ten times as far away, too.
"""

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from experiments.problems.residual_functions import FUNCTIONS
from experiments.problems.task import Task, Truth, least_squares

Kind = Literal["smooth", "noisy", "wild", "nondifferentiable"]
NOISE = 1e-3
"""Relative, of the noisy and the wild kind."""
_POSITIVE = ("bard", "kowalik_osborne", "jennrich_sampson", "brown_almost_linear", "osborne_1", "osborne_2")
"""Functions whose nondifferentiable kind has max(x, 0) in place of x, as in the code of the authors."""


@dataclass(frozen=True)
class Problem:
    """A function with n parameters and m residuals, and how many times as far from zero as usual it starts."""

    function: str
    n: int
    m: int
    scale: float = 1.0

    @property
    def name(self) -> str:
        """Name of the task."""
        return f"{self.function}_n{self.n}" + ("" if self.scale == 1.0 else "_far")


def _twice(function: str, *sizes: tuple[int, int]) -> list[Problem]:
    return [Problem(function, n, m, scale) for n, m in sizes for scale in (1.0, 10.0)]


def _once(function: str, *sizes: tuple[int, int]) -> list[Problem]:
    return [Problem(function, n, m) for n, m in sizes]


PROBLEMS = (
    *_twice("linear_full_rank", (9, 45)),
    *_twice("linear_rank_one", (7, 35)),
    *_twice("linear_rank_one_with_zeros", (7, 35)),
    *_twice("rosenbrock", (2, 2)),
    *_twice("helical_valley", (3, 3)),
    *_twice("powell_singular", (4, 4)),
    *_twice("freudenstein_roth", (2, 2)),
    *_twice("bard", (3, 15)),
    *_once("kowalik_osborne", (4, 11)),
    *_once("meyer", (3, 16)),
    *_twice("watson", (6, 31), (9, 31), (12, 31)),
    *_once("box_3d", (3, 10)),
    *_once("jennrich_sampson", (2, 10)),
    *_twice("brown_dennis", (4, 20)),
    *_once("chebyquad", (6, 6), (7, 7), (8, 8), (9, 9), (10, 10), (11, 11)),
    *_once("brown_almost_linear", (10, 10)),
    *_once("osborne_1", (5, 33)),
    *_twice("osborne_2", (11, 65)),
    *_once("bdqrtic", (8, 8), (10, 12), (11, 14), (12, 16)),
    *_once("cube", (5, 5), (6, 6), (8, 8)),
    *_twice("mancino", (5, 5)),
    *_once("mancino", (8, 8), (10, 10)),
    *_twice("mancino", (12, 12)),
    *_twice("heart", (8, 8)),
)
"""The 53 problems."""


def task(problem: Problem, evaluations: int, kind: Kind = "smooth") -> Task:
    """Return a problem as a task whose error is the mean of the squared residuals, without noise.

    The "smooth" loss is the mean of the squared residuals, and its residuals are known. Of the other kinds the loss
    alone is known: "noisy" has a relative noise in every residual that is new at every call, "wild" an oscillation of
    the loss in its place, and "nondifferentiable" is the mean of the residuals' magnitudes, which then is the error,
    too.
    """
    function, n = FUNCTIONS[problem.function], problem.n
    first = problem.scale * function.start(n)
    size = max(float(first.abs().max()), 1.0)
    generator = torch.Generator().manual_seed(0)

    def residuals(x: Tensor) -> Tensor:
        values = function.residuals(x, problem.m)
        return torch.where(values.isfinite(), values, 1e100).clamp(-1e100, 1e100)

    def exact(x: Tensor) -> Tensor:
        if kind == "nondifferentiable":
            return residuals(x.clamp_min(0.0) if problem.function in _POSITIVE else x).abs().mean(1)
        return residuals(x).square().mean(1)

    def error(x: Tensor) -> float:
        return float(exact(x[None])[0])

    def loss(x: Tensor) -> Tensor:
        if kind == "noisy":
            drawn = 2.0 * torch.rand(len(x), problem.m, generator=generator, dtype=torch.float64) - 1.0
            return (residuals(x) * (1.0 + NOISE * drawn)).square().mean(1)
        return exact(x) * (1.0 + NOISE * _oscillation(x)) if kind == "wild" else exact(x)

    def start(run: int) -> Tensor:
        if not run:
            return first
        return first + size * torch.randn(n, generator=torch.Generator().manual_seed(run), dtype=torch.float64)

    return Task(
        name=problem.name if kind == "smooth" else f"{problem.name}_{kind}",
        title=f"{problem.function}, {n} parameters, {problem.m} residuals",
        parameters="",
        needs="",
        n=n,
        start=start,
        sigma=0.1 * size,
        evaluations=evaluations,
        loss=loss,
        output=least_squares(residuals, lambda out: out) if kind == "smooth" else None,
        truth=Truth(error, error, precision=0.0),  # a run ends where nothing is left, or with its evaluations
    )


def _oscillation(x: Tensor) -> Tensor:
    """Return an oscillation [K] between -1 and 1 of points [K, n] (More and Wild 2009, section 4)."""
    one = 0.9 * (100.0 * x.abs().sum(1)).sin() * (100.0 * x.abs().amax(1)).cos() + 0.1 * x.norm(dim=1).cos()
    return one * (4.0 * one**2 - 3.0)
