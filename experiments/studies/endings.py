"""Evaluations after which a search of a smooth convex function ends by itself, without being told a target.

COBYQA and Py-BOBYQA are local searches. `zh.minimize` with `restarts=0` is one, too. Without `restarts` it begins again
at random points until three rounds have arrived at the same minimum. All begin with a region of the same size.
"""

import math
import statistics
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.smooth_losses import Function, functions, lowest
from experiments.reports import result_files
from experiments.reports.progress import progress

CONVEX = (
    "sphere",
    "quadratic, condition 100",
    "log cosh, condition 100",
    "logistic regression",
    "exponentials",
    "pseudo-Huber",
)
"""Losses of `smooth_losses` on which searches end."""
METHODS = ("restarts=0", "default", "cobyqa", "py_bobyqa")
HEADERS = ("function", "parameters", "box", *METHODS, "ratio", "worst ratio", "error left", "error of cobyqa", "runs")
_SIGMA = 2.0
"""Size of the first region: sigma of ours, the radius of the rivals."""
_BOX = 5.0
"""Half the width of the box around 0."""
_MOST = 5_000
"""Evaluations of a search, at most."""


@dataclass(frozen=True)
class End:
    """How one search has ended."""

    evaluations: int
    error: float
    """Loss above the minimum at the point that is returned, over the one at the start."""


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
    cases = [(name, size, box) for size in n for box in (False, True) for name in CONVEX]
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
