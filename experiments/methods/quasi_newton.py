"""Quasi-Newton methods: on sampled gradients, as in the source's supplement F, and on finite differences.

The source reports that on sampled gradients all of them converge on QUAD only, "probably due to the noisy nature of
the derivative estimation". Each is here with fresh samples for every estimate and, as its `frozen` variant, with the
same samples for all of them, which takes that noise away.

Sigma anneals linearly from `start` to `end` times `Task.sigma`.
"""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import BFGS, OptimizeResult, line_search, minimize
from torch import Tensor

from experiments.methods.adaptive_differences import bfgs_adaptive_fd
from experiments.methods.annealing import Annealing
from experiments.methods.bounds import scipy_bounds
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.restarts import starts
from experiments.methods.sampled import SampledGradient
from experiments.runs.trial import Trial

Array = NDArray[np.float64]
SHORTEST = 1e-3
"""Step, in units of sigma, along a direction in which the line search finds none."""


def bfgs(
    trial: Trial,
    *,
    samples: int = 4,
    start: float = 1.0,
    end: float = 0.01,
    steps: int = 100,
    longest: float = math.inf,
    frozen: bool = False,
    wolfe: bool = False,
    damped: bool = False,
) -> None:
    """BFGS (Nocedal and Wright 2006, algorithm 6.1) on sampled gradients, with the updates of SciPy.

    Args:
        trial: the run.
        samples: antithetic pairs of an estimate.
        start: sigma at the start, in units of `Task.sigma`.
        end: sigma at the end.
        steps: iterations from start to end.
        longest: no step is longer than this, in units of sigma.
        frozen: the same samples for all estimates.
        wolfe: step lengths from a line search with the strong Wolfe conditions (SciPy), instead of the unit step.
        damped: Powell's damping (procedure 18.2) where the curvature is not positive, instead of leaving out the
            update.
    """
    sampled = SampledGradient(trial, samples, frozen=frozen)
    annealing = Annealing.of(trial.task, start, end, steps)
    curvature = _curvature(trial.task.n, damped)
    x, iteration, sigma = trial.start, 0, annealing(0)
    value, gradient = sampled(x, sigma)
    while True:
        g = gradient.numpy()
        try:
            direction = -(np.linalg.solve(curvature.get_matrix(), g) if damped else curvature.dot(g))
        except np.linalg.LinAlgError:  # what noise can make of it
            curvature, direction = _curvature(trial.task.n, damped), -g
        direction *= min(1.0, longest * sigma / max(float(np.linalg.norm(direction)), 1e-300))
        length = _strong_wolfe(sampled, x, sigma, direction, value, gradient) if wolfe else 1.0
        step = torch.from_numpy(length * direction)
        x, iteration = x + step, iteration + 1
        sigma = annealing(iteration)
        before = gradient
        value, gradient = sampled(x, sigma)
        change = gradient - before
        if bool(step.any()) and bool(change.any()):
            curvature.update(step.numpy(), change.numpy())
        trial.report(x, sigma=sigma, loss=value)


def _curvature(n: int, damped: bool) -> BFGS:
    """A Hessian to be updated if `damped`, because Powell's damping is of the Hessian; otherwise its inverse."""
    curvature = BFGS(exception_strategy="damp_update" if damped else "skip_update")
    curvature.initialize(n, "hess" if damped else "inv_hess")
    return curvature


def _strong_wolfe(
    sampled: SampledGradient, x: Tensor, sigma: float, direction: Array, value: float, gradient: Tensor
) -> float:
    """Return the length of the step; one estimate serves value and gradient of a point."""
    norm = float(np.linalg.norm(direction))
    if norm == 0.0:
        return 0.0
    known: dict[bytes, tuple[float, Array]] = {x.numpy().tobytes(): (value, gradient.numpy())}

    def at(point: Array) -> tuple[float, Array]:
        key = point.tobytes()
        if key not in known:
            f, g = sampled(torch.from_numpy(point), sigma)
            known[key] = f, g.numpy()
        return known[key]

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # that it found none
        length = line_search(
            lambda point: at(point)[0], lambda point: at(point)[1], x.numpy(), direction, gradient.numpy(), value
        )[0]
    return SHORTEST * sigma / norm if length is None else float(length)


def lbfgs(
    trial: Trial,
    *,
    samples: int = 4,
    start: float = 1.0,
    end: float = 0.01,
    steps: int = 20,
    inner: int = 5,
    frozen: bool = False,
) -> None:
    """L-BFGS of torch with its strong-Wolfe line search, on sampled gradients.

    Args:
        trial: the run.
        samples: antithetic pairs of an estimate.
        start: sigma at the start, in units of `Task.sigma`.
        end: sigma at the end.
        steps: from start to end, of `inner` iterations each.
        inner: iterations at one sigma, reported together.
        frozen: the same samples for all estimates.
    """
    sampled = SampledGradient(trial, samples, frozen=frozen)
    annealing = Annealing.of(trial.task, start, end, steps)
    x = trial.start.clone().requires_grad_()
    # Tolerances of zero: the search goes on as long as there are evaluations.
    optimizer = torch.optim.LBFGS(
        [x], max_iter=inner, tolerance_grad=0.0, tolerance_change=0.0, line_search_fn="strong_wolfe"
    )
    step = 0
    while True:
        sigma = annealing(step)

        def closure(sigma: float = sigma) -> float:
            value, x.grad = sampled(x, sigma)
            return value

        value = optimizer.step(closure)
        step += 1
        trial.report(x, sigma=sigma, loss=float(value))


def bfgs_fd(trial: Trial, *, difference: float = 1e-3) -> None:
    """BFGS of SciPy on forward differences of the black box itself, `difference` in units of `Task.sigma`."""
    _scipy(trial, "BFGS", {"eps": difference * trial.task.sigma, "gtol": 0.0})


def lbfgs_fd(trial: Trial, *, difference: float = 1e-3) -> None:
    """L-BFGS-B of SciPy, with the bounds of the task, on forward differences of the black box itself."""
    limits = {"maxfun": trial.task.evaluations, "maxiter": trial.task.evaluations}
    _scipy(trial, "L-BFGS-B", {"eps": difference * trial.task.sigma, "gtol": 0.0, "ftol": 0.0, **limits})


def _scipy(trial: Trial, method: str, options: dict[str, Any]) -> None:
    def loss(x: Array) -> float:
        return float(trial.loss(torch.tensor(x[None], dtype=torch.float64))[0])

    def callback(intermediate_result: OptimizeResult) -> None:
        trial.report(torch.tensor(intermediate_result.x), loss=float(intermediate_result.fun))

    within = scipy_bounds(trial.task) if method == "L-BFGS-B" else None
    for start in starts(trial):
        minimize(loss, start.numpy(), method=method, bounds=within, callback=callback, options=options)


def _method(name: str, title: str, solve: Callable[..., None], **fixed: bool) -> Method:
    return Method(name, title, with_settings(solve, **fixed), packages=("scipy",))


METHODS = (
    _method("bfgs", "BFGS with unit steps on sampled gradients", bfgs),
    _method("bfgs_wolfe", "BFGS with a strong-Wolfe line search on sampled gradients", bfgs, wolfe=True),
    _method("lbfgs", "L-BFGS of torch, strong Wolfe, on sampled gradients", lbfgs),
    _method("bfgs_damped", "BFGS with Powell's damping on sampled gradients", bfgs, damped=True),
    _method("bfgs_adaptive_fd", "BFGS on noise-aware finite differences of sampled values", bfgs_adaptive_fd),
    _method("bfgs_frozen", "bfgs with the same samples for all gradients", bfgs, frozen=True),
    _method("bfgs_wolfe_frozen", "bfgs_wolfe with the same samples", bfgs, wolfe=True, frozen=True),
    _method("lbfgs_frozen", "lbfgs with the same samples", lbfgs, frozen=True),
    _method("bfgs_damped_frozen", "bfgs_damped with the same samples", bfgs, damped=True, frozen=True),
    _method("bfgs_adaptive_fd_frozen", "bfgs_adaptive_fd with the same samples", bfgs_adaptive_fd, frozen=True),
    _method("bfgs_fd", "BFGS of SciPy on finite differences of the black box, with restarts", bfgs_fd),
    _method("lbfgs_fd", "L-BFGS-B of SciPy on finite differences of the black box, with restarts", lbfgs_fd),
)
