"""What the estimators are measured on: the BOX tasks, MUG and plane waves, each with the truth at one point.

The truth of a plane wave is a closed form. The loss of MUG is looked up in a table of renders over a whole turn and
interpolated, and its truth is a quadrature with far more nodes than the table has. The truth of the BOX tasks is a far
larger sample of scrambled Sobol points, which shares no code with the estimators; its own standard error is reported.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems import catalogue
from experiments.problems.closed_forms import PlaneWave
from experiments.problems.soft_squares import BoxTask, box2, box10

Function = Callable[[Tensor], Tensor]
Quantities = dict[str, Tensor]
QUANTITIES = ("value", "gradient", "hessian", "hvp")
PROBLEMS = {"BOX2": 2, "BOX10": 10, "MUG": 1, "WAVE2": 2, "WAVE10": 10}
"""Parameters of each."""
_TURN = 18.0
"""A turn of MUG, in its units of 20 degrees."""
_ANGLES = 360
"""Renders of MUG over a turn."""
_NODES = 100_001
"""Of the quadrature, over 9 sigma to each side."""
_TRUTH_SCRAMBLES = 16


@dataclass(frozen=True)
class Problem:
    """A black box, a point, a sigma, and the true value and derivatives there."""

    name: str
    fn: Function
    x: Tensor
    sigma: float
    v: Tensor
    truth: Quantities
    truth_error: dict[str, float]
    """Relative standard error of the truth."""
    image: Function | None = None
    """[K, n] -> [K, *out], of which `fn` is the mean squared difference to `reference`, where there is one."""
    reference: Tensor | None = None
    memories: dict[str, zh.Memory] = field(default_factory=dict)
    """Memories that have served earlier estimates at x, by the name of the estimator."""


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
        squares = task.loss
        reference = squares.image(squares.target[None])[0].float()
        return Problem(
            *(name, fn, task.start, task.sigma, v, truth, errors), lambda z: squares.image(z.float()), reference
        )
    if name == "MUG":
        mug = catalogue.fitting("mug")
        mug_x, angles = torch.tensor([9.5]).double(), _TURN * torch.arange(_ANGLES).double() / _ANGLES
        table = looked_up(mug.loss(angles[:, None]), _TURN)
        truth = quadrature(table, mug_x, mug.sigma, v)
        return Problem(name, table, mug_x, mug.sigma, v, truth, dict.fromkeys(QUANTITIES, 0.0))
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


def looked_up(values: Tensor, period: float) -> Function:
    """Return a periodic function of points [K, 1]: values at equal distances from 0 on, joined by straight lines."""

    def fn(points: Tensor) -> Tensor:
        place = torch.remainder(points[:, 0].double(), period) / period * len(values)
        left = place.floor()
        index = left.long() % len(values)
        return torch.lerp(values[index], values[(index + 1) % len(values)], place - left)

    return fn


def quadrature(fn: Function, x: Tensor, sigma: float, v: Tensor) -> Quantities:
    """Return the quantities at x [1] for one parameter: Stein's identities by the trapezoid rule."""
    u = torch.linspace(-9.0, 9.0, _NODES, dtype=torch.float64)
    weighted = fn(x + sigma * u[:, None]) * torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi)
    value, first, second = (
        torch.trapezoid(weighted * kernel, u) for kernel in (torch.ones_like(u), u / sigma, (u * u - 1) / sigma**2)
    )
    return {"value": value, "gradient": first[None], "hessian": second[None, None], "hvp": second * v}
