"""Evaluations after which a search of a smooth convex function ends by itself, without being told a target.

COBYQA and Py-BOBYQA are local searches. `zh.minimize` with `restarts=0` is one, too. Without `restarts` it begins again
at random points until three rounds have arrived at the same minimum. All begin with a region of the same size.
"""

import math
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

import torch_zerohess as zh
from experiments.reports import result_files
from experiments.reports.progress import progress

METHODS = ("restarts=0", "default", "cobyqa", "py_bobyqa")
HEADERS = ("function", "parameters", "box", *METHODS, "ratio", "worst ratio", "error left", "error of cobyqa", "runs")
_SIGMA = 2.0
"""Size of the first region: sigma of ours, the radius of the rivals."""
_BOX = 5.0
"""Half the width of the box around 0."""
_EXAMPLES = 20
"""Of the logistic regression, per parameter."""
_MOST = 5_000
"""Evaluations of a search, at most."""

Function = Callable[[Tensor], Tensor]


@dataclass(frozen=True)
class End:
    """How one search has ended."""

    evaluations: int
    error: float
    """Loss above the minimum at the point that is returned, over the one at the start."""


def functions(n: int, run: int) -> dict[str, Function]:
    """Return convex functions [K, n] -> [K] by name, rotated at random, with their minima within a unit of 0."""
    generator = torch.Generator().manual_seed(run)
    settings: dict[str, Any] = {"generator": generator, "dtype": torch.float64}
    axes = torch.linalg.qr(torch.randn(n, n, **settings))[0]
    place = 2 * torch.rand(n, **settings) - 1
    scale = torch.logspace(0, 2, n, dtype=torch.float64)
    examples = torch.randn(_EXAMPLES * n, n, **settings)
    classes = torch.where(torch.rand(_EXAMPLES * n, **settings) < torch.sigmoid(3 * examples @ place), 1.0, -1.0)

    def u(z: Tensor) -> Tensor:
        return (z - place) @ axes

    return {
        "sphere": lambda z: u(z).square().sum(1),
        "quadratic, condition 100": lambda z: (u(z).square() * scale).sum(1),
        "log cosh, condition 100": lambda z: torch.cosh(u(z) * scale.sqrt()).log().sum(1),
        "logistic regression": lambda z: (
            torch.nn.functional.softplus(-(z @ examples.mT) * classes).mean(1) + 0.01 * z.square().sum(1)
        ),
        "exponentials": lambda z: (u(z).exp() + (-2 * u(z)).exp()).sum(1),
        "pseudo-Huber": lambda z: (1 + 10 * u(z).square()).sqrt().sum(1),
    }


def lowest(function: Function, n: int) -> float:
    """Return the minimum of a convex function, by Newton's method on its own derivatives."""

    def loss(z: Tensor) -> Tensor:
        return function(z[None])[0]

    x = torch.zeros(n, dtype=torch.float64)
    for _ in range(200):
        step = torch.linalg.solve(torch.func.hessian(loss)(x), torch.func.grad(loss)(x))
        while float(loss(x - step)) > float(loss(x)) and float(step.norm()) > 1e-12:
            step = 0.5 * step
        if torch.equal(x - step, x):  # all further steps are the same
            break
        x = x - step
    return float(loss(x))


def ended(method: str, function: Function, start: Tensor, minimum: float, *, box: bool, seed: int) -> End:
    """Search until the method ends by itself."""
    losses: list[float] = []

    def evaluate(x: Any) -> float:
        losses.append(float(function(torch.as_tensor(x, dtype=torch.float64)[None])[0]))
        return losses[-1]

    n = len(start)
    if method in ("restarts=0", "default"):
        found = zh.minimize(
            function,
            start,
            sigma=_SIGMA,
            bounds=(-_BOX, _BOX) if box else None,
            restarts=0 if method == "restarts=0" else None,
            max_evaluations=_MOST,
            seed=seed,
        )
        evaluations, value = found.evaluations, found.value
    elif method == "cobyqa":
        bounds = [(-_BOX, _BOX)] * n if box else None
        options = {"initial_tr_radius": _SIGMA, "maxfev": _MOST, "maxiter": _MOST}
        value = float(minimize(evaluate, start.numpy(), method="COBYQA", bounds=bounds, options=options).fun)
        evaluations = len(losses)
    else:
        import pybobyqa

        sides = (np.full(n, -_BOX), np.full(n, _BOX)) if box else None
        with np.errstate(all="ignore"):
            value = float(pybobyqa.solve(evaluate, start.numpy(), bounds=sides, rhobeg=_SIGMA, maxfun=_MOST).f)
        evaluations = len(losses)
    return End(evaluations, (value - minimum) / (float(function(start[None])[0]) - minimum))


def endings(
    n: tuple[int, ...] = (2, 4, 10), runs: int = 10, seed: int = 0, store: str | None = None
) -> list[list[Any]]:
    """Print after how many evaluations searches of smooth convex functions end by themselves.

    Args:
        n: parameters, 2 or more.
        runs: functions of each kind and starts, from normal variates.
        seed: of the first run.
        store: name under which the table is kept.
    """
    if not n or min(n) < 2 or runs < 1:
        raise SystemExit(f"n must be 2 or more and runs at least 1, got {n} and {runs}")
    result_files.may_keep(store)
    torch.set_num_threads(1)
    cases = [(name, size, box) for size in n for box in (False, True) for name in functions(size, 0)]
    rows = [row(name, size, runs, seed, box=box) for name, size, box in progress(cases, "cases")]
    result_files.show(HEADERS, rows, store)
    return rows


def row(name: str, n: int, runs: int, seed: int, *, box: bool) -> list[Any]:
    """Return medians over runs of one kind of function, and the ratios to COBYQA's evaluations.

    The errors are the largest of the runs, of `restarts=0` and of COBYQA.
    """
    ends: dict[str, list[End]] = {method: [] for method in METHODS}
    for run in range(seed, seed + runs):
        function = functions(n, run)[name]
        minimum = lowest(function, n)
        start = torch.randn(n, generator=torch.Generator().manual_seed(1_000_000 + run), dtype=torch.float64)
        for method in METHODS:
            ends[method].append(ended(method, function, start, minimum, box=box, seed=run))
    medians = [statistics.median(end.evaluations for end in ends[method]) for method in METHODS]
    ratios = [ours.evaluations / its.evaluations for ours, its in zip(ends["restarts=0"], ends["cobyqa"], strict=True)]
    errors = [max(0.0, *(end.error for end in ends[method])) for method in ("restarts=0", "cobyqa")]
    middle = math.exp(statistics.fmean(map(math.log, ratios)))
    return [name, n, "yes" if box else "no", *medians, middle, max(ratios), *errors, runs]
