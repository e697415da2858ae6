"""What the estimators are measured on: the BOX tasks and a plane wave, each with the truth at one point.

The truth of the plane wave is a closed form. The truth of the BOX tasks is a far larger sample of scrambled Sobol
points, which shares no code with the estimators; its own standard error is reported.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.problems.closed_forms import PlaneWave
from experiments.problems.soft_squares import BoxTask, box2, box10

Function = Callable[[Tensor], Tensor]
Quantities = dict[str, Tensor]
QUANTITIES = ("value", "gradient", "hessian", "hvp")
PROBLEMS = {"BOX2": 2, "BOX10": 10, "WAVE10": 10}
"""Parameters of each."""
_TRUTH_SCRAMBLES = 16


@dataclass(frozen=True)
class Problem:
    """A black box, a point, a sigma and what is true there."""

    name: str
    fn: Function
    x: Tensor
    sigma: float
    v: Tensor
    truth: Quantities
    truth_error: dict[str, float]
    """Relative standard error of the truth."""


def made_problem(name: str, truth_evaluations: int, side: int, seed: int) -> Problem:
    tasks: dict[str, Callable[[int], BoxTask]] = {"BOX2": box2, "BOX10": box10}
    n = PROBLEMS[name]
    generator = torch.Generator().manual_seed(seed)
    v = torch.nn.functional.normalize(torch.randn(n, generator=generator, dtype=torch.float64), dim=0)
    if name in tasks:
        task = tasks[name](side)

        def fn(points: Tensor) -> Tensor:
            return task.loss(points.float()).double()  # single precision is far below the noise, and faster

        truth, errors = _sampled_truth(fn, task.start, task.sigma, v, truth_evaluations, seed)
        return Problem(name, fn, task.start, task.sigma, v, truth, errors)
    sigma = 0.5
    k = torch.nn.functional.normalize(torch.randn(n, generator=generator, dtype=torch.float64), dim=0) / sigma
    x = torch.zeros(n, dtype=torch.float64)
    wave, scale = PlaneWave(k, phase=0.7 + math.pi / 2), torch.full((n,), sigma, dtype=torch.float64)
    hessian = wave.hessian(x, scale)
    truth = {"value": wave.value(x, scale), "gradient": wave.gradient(x, scale), "hessian": hessian}
    truth["hvp"] = hessian @ v
    return Problem(name, wave, x, sigma, v, truth, dict.fromkeys(QUANTITIES, 0.0))


def _sampled_truth(
    fn: Function, x: Tensor, sigma: float, v: Tensor, evaluations: int, seed: int
) -> tuple[Quantities, dict[str, float]]:
    """Stein's identities written out, on antithetic pairs of independently scrambled Sobol points.

    Returns the quantities and their relative standard errors, from the spread of the scrambles.
    """
    count = 2 ** max(8, round(math.log2(evaluations / (2 * _TRUTH_SCRAMBLES))))
    n, center = len(x), fn(x[None])
    estimates: dict[str, list[Tensor]] = {name: [] for name in QUANTITIES}
    for scramble in range(_TRUTH_SCRAMBLES):
        engine = torch.quasirandom.SobolEngine(n, scramble=True, seed=1_000_003 * (seed + 1) + scramble)
        u = torch.special.ndtri(engine.draw(count, dtype=torch.float64) + 2.0**-31)
        plus, minus = fn(x + sigma * u) - center, fn(x - sigma * u) - center
        even, odd = (plus + minus) / 2, (plus - minus) / 2
        hessian = ((u * even[:, None]).mT @ u / count - even.mean() * torch.eye(n, dtype=torch.float64)) / sigma**2
        estimates["value"].append(center[0] + even.mean())
        estimates["gradient"].append(odd @ u / count / sigma)
        estimates["hessian"].append(hessian)
        estimates["hvp"].append(hessian @ v)
    stacked = {name: torch.stack(values) for name, values in estimates.items()}
    truth = {name: values.mean(0) for name, values in stacked.items()}
    errors = {
        name: float((values.std(0) / math.sqrt(_TRUTH_SCRAMBLES)).norm() / truth[name].norm())
        for name, values in stacked.items()
    }
    return truth, errors
