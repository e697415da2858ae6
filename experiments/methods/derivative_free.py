"""Derivative-free optimizers that a user would pick instead of ours: CMA-ES, COBYQA, Py-BOBYQA and DFO-LS.

Each is the implementation that its package ships, with the package's own settings but for the size of the first step,
which is `Task.sigma` times `scale`. They report the best point that they have evaluated. Methods that choose their
points one by one report after every evaluation, CMA-ES after every generation.
"""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.optimize import minimize

from experiments.methods.best import Array, Best
from experiments.methods.bounds import is_bounded, scipy_bounds
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.restarts import starts
from experiments.problems.task import Task
from experiments.runs.trial import Trial

MOST = 100
"""Parameters beyond which COBYQA, made for small problems, takes minutes between two evaluations."""
MOST_RESIDUALS = 2000
"""Parameters beyond which DFO-LS, which keeps the residuals of n points, takes gigabytes."""


def cma_es(trial: Trial, *, scale: float = 1.0, bounded: bool = False) -> None:
    """CMA-ES of pycma with its default population 4 + floor(3 ln n), and with bounds if `bounded`.

    Where it stops by itself, as it does on a plateau, it starts again from a random point with twice the population
    (Auger and Hansen 2005, "A restart CMA evolution strategy with increasing population size"), until the evaluations
    are used up. pycma wants two parameters: a single one gets a second that changes nothing.
    """
    import cma

    options: dict[str, Any] = {"verbose": -9, "seed": np.nan}
    rng = np.random.default_rng(trial.seed)
    options["randn"] = lambda *shape: rng.standard_normal(shape)
    n = trial.task.n
    more = [0.0] if n == 1 else []
    if bounded:
        assert trial.task.bounds is not None
        lower, upper = (one.tolist() for one in trial.task.bounds)
        options["bounds"] = [lower + [-1.0] * len(more), upper + [1.0] * len(more)]
    best, population = Best(trial), 4 + int(3 * math.log(n))
    for start in starts(trial):
        strategy = cma.CMAEvolutionStrategy(
            start.tolist() + more, scale * trial.task.sigma, {**options, "popsize": population}
        )
        while not strategy.stop():
            drawn = np.array(strategy.ask())
            points = np.ascontiguousarray(drawn[:, :n])
            values = trial.loss(torch.from_numpy(points)).numpy()
            strategy.tell(list(drawn), values.tolist())
            best(points, values, sigma=float(strategy.sigma))
        population *= 2


def cobyqa(trial: Trial, *, scale: float = 1.0) -> None:
    """COBYQA of SciPy: a trust region with quadratic models of least change (Ragonneau and Zhang 2022).

    Where its region has shrunk to nothing it starts again from a random point.
    """
    evaluate = _one_by_one(trial)
    options = {
        "maxfev": trial.task.evaluations,
        "maxiter": trial.task.evaluations,
        "initial_tr_radius": scale * trial.task.sigma,
        "final_tr_radius": 1e-8 * scale * trial.task.sigma,
    }
    for start in starts(trial):
        minimize(evaluate, start.numpy(), method="COBYQA", bounds=scipy_bounds(trial.task), options=options)


def dfo_ls(trial: Trial, *, scale: float = 1.0) -> None:
    """DFO-LS: Gauss-Newton on interpolated residuals (Cartis, Fiala, Marteau and Roberts 2019).

    Where its region has shrunk to nothing it starts again from a random point.
    """
    import dfols

    assert trial.task.output is not None
    residuals, best = trial.task.output.residuals, Best(trial)
    assert residuals is not None

    def evaluate(x: Array) -> Array:
        values: Array = residuals(trial.image(torch.tensor(x[None], dtype=torch.float64))[0]).numpy()
        best(x[None], np.array([np.mean(values**2)]))
        return values

    _interpolate(trial, dfols.solve, evaluate, rhobeg=scale * trial.task.sigma)


def py_bobyqa(trial: Trial, *, scale: float = 1.0, seek_global_minimum: bool = True) -> None:
    """Py-BOBYQA: quadratic interpolation in a trust region (Cartis, Fiala, Marteau and Roberts 2019).

    With `seek_global_minimum` it starts again with a larger region where the last one has shrunk to nothing (Cartis,
    Roberts and Sheridan-Methven 2022), which needs bounds. Where that finds nothing either, it has a further start.
    """
    import pybobyqa

    _interpolate(
        trial,
        pybobyqa.solve,
        _one_by_one(trial),
        rhobeg=scale * trial.task.sigma,
        rhoend=1e-8 * scale * trial.task.sigma,
        seek_global_minimum=seek_global_minimum and trial.task.bounds is not None,
    )


def _interpolate(trial: Trial, solve: Callable[..., object], evaluate: Callable[[Array], Any], **settings: Any) -> None:
    """Call the solver of DFO-LS or Py-BOBYQA, which have the same interface, from one start after the other."""
    bounds = trial.task.bounds
    for start in starts(trial):
        solve(
            evaluate,
            start.numpy(),
            bounds=None if bounds is None else tuple(one.numpy() for one in bounds),
            maxfun=trial.task.evaluations,
            do_logging=False,
            **settings,
        )


def _one_by_one(trial: Trial) -> Callable[[Array], float]:
    """The loss of one point, reported at once."""
    best = Best(trial)

    def evaluate(x: Array) -> float:
        value = trial.loss(torch.tensor(x[None], dtype=torch.float64)).numpy()
        best(x[None], value)
        return float(value[0])

    return evaluate


def _is_small(task: Task) -> str | None:
    return f"is for small problems, minutes between evaluations at n = {task.n}" if task.n > MOST else None


def _has_residuals(task: Task) -> str | None:
    if task.n > MOST_RESIDUALS:
        return f"its interpolation takes gigabytes at n = {task.n}"
    return None if task.output and task.output.residuals else "the black box returns no residuals"


METHODS = (
    Method("cma_es", "CMA-ES (pycma) with restarts", with_settings(cma_es), packages=("cma",)),
    Method(
        "cma_es_bounded",
        "CMA-ES (pycma) with restarts and bounds",
        with_settings(cma_es, bounded=True),
        is_bounded,
        ("cma",),
    ),
    Method("cobyqa", "COBYQA (SciPy), quadratic models, with restarts", with_settings(cobyqa), _is_small, ("scipy",)),
    Method(
        "py_bobyqa",
        "Py-BOBYQA, quadratic models with restarts",
        with_settings(py_bobyqa),
        _is_small,
        ("Py-BOBYQA",),
    ),
    Method(
        "dfo_ls",
        "DFO-LS, Gauss-Newton on residuals, with restarts",
        with_settings(dfo_ls),
        _has_residuals,
        ("DFO-LS",),
        uses="image",
    ),
)
