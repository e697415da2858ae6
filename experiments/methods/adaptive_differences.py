"""BFGS on finite differences whose interval adapts to the noise of the function.

Berahas, Byrd and Nocedal 2019, "Derivative-free optimization of noisy functions via quasi-Newton methods", with the
noise from the difference table of More and Wild 2011, "Estimating computational noise". The function is the smoothed
value of the black box from a few samples, as for the other quasi-Newton methods of the source's supplement F; with
frozen samples it is deterministic.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import BFGS
from torch import Tensor

from experiments.methods.annealing import Annealing
from experiments.methods.sampled import SampledGradient
from experiments.runs.trial import Trial

Array = NDArray[np.float64]
Function = Callable[[Tensor], float]
POINTS = 7
"""Of a difference table."""
ARMIJO, SHORTENINGS = 1e-4, 15


def bfgs_adaptive_fd(
    trial: Trial,
    *,
    samples: int = 2,
    start: float = 1.0,
    end: float = 0.01,
    steps: int = 50,
    frozen: bool = False,
) -> None:
    """BFGS on forward differences of the sampled smoothed value, with a line search that is relaxed by the noise.

    A step is accepted if f(x + a d) <= f(x) + 1e-4 a g.d + 2 noise. Where the line search finds none, noise and
    interval are estimated anew and the curvature is forgotten.

    Args:
        trial: the run.
        samples: antithetic pairs of a smoothed value.
        start: sigma at the start, in units of `Task.sigma`.
        end: sigma at the end.
        steps: iterations from start to end.
        frozen: the same samples for all values.
    """
    sampled = SampledGradient(trial, samples, frozen=frozen)
    annealing = Annealing.of(trial.task, start, end, steps)
    rng = np.random.default_rng(trial.seed)
    x, iteration, n = trial.start, 0, trial.task.n
    curvature, interval, sigma = _fresh(n), None, annealing(0)

    def function(point: Tensor) -> float:
        return sampled.value(point, sigma)

    while True:
        if interval is None:
            direction = torch.from_numpy(rng.standard_normal(n))
            interval = adapt(function, x, direction / direction.norm(), sigma)
            value, gradient = _forward(function, x, interval.length)
        with np.errstate(all="ignore"):  # curvature made of noise may overflow
            descent = -curvature.dot(gradient)
        length = _armijo(function, x, value, descent, float(gradient @ descent), interval.noise)
        iteration += 1
        sigma = annealing(iteration)
        if length is None:
            curvature, interval = _fresh(n), None
        else:
            step = length * descent
            x, before = x + torch.from_numpy(step), gradient
            value, gradient = _forward(function, x, interval.length)
            if step.any() and (gradient != before).any():
                with np.errstate(all="ignore"):
                    curvature.update(step, gradient - before)
        trial.report(x, sigma=sigma, loss=value)


@dataclass(frozen=True)
class Interval:
    """Standard deviation of the noise of a function, and the length of differences that suits it."""

    noise: float
    length: float


def adapt(function: Function, x: Tensor, direction: Tensor, sigma: float) -> Interval:
    """Estimate noise and second derivative along a unit direction [n]; sigma is how far the function is smooth.

    The error of a forward difference over h is at most about 2 noise / h + h |f''| / 2; its best h is
    8^(1/4) (noise / |f''|)^(1/2) in terms of the standard deviation of the noise (More and Wild 2012).
    """

    def along(t: float) -> float:
        return function(x + t * direction)

    center = along(0.0)
    noise = max(_noise(along, sigma), float(np.finfo(float).eps) * abs(center), 1e-300)
    reach = sigma * min((noise / max(abs(center), noise)) ** 0.25, 1.0)
    bend = 0.0
    for _ in range(2):
        difference = abs(along(reach) - 2 * center + along(-reach))
        bend = max(difference, noise) / reach**2
        if difference >= 100 * noise:
            break
        reach = min((100 * noise / bend) ** 0.5, sigma)
    return Interval(noise, min(8**0.25 * math.sqrt(noise / bend), sigma))


def _noise(along: Callable[[float], float], sigma: float) -> float:
    """Return the noise from difference tables of smaller and smaller spacing; 0 if none shows any."""
    for spacing in (1e-2, 1e-4, 1e-6):
        table = np.array([along(sigma * spacing * (k - POINTS // 2)) for k in range(POINTS)])
        levels, changes = [], []
        for k in range(1, POINTS):
            table = np.diff(table)
            levels.append(math.sqrt(math.factorial(k) ** 2 / math.factorial(2 * k) * np.mean(table**2)))
            changes.append(bool((table[1:] * table[:-1] < 0).any()) if len(table) > 1 else True)
        for k in range(len(levels) - 2):
            three = levels[k : k + 3]
            if changes[k] and 0 < max(three) <= 4 * min(three):
                return levels[k]
    return 0.0


def _fresh(n: int) -> BFGS:
    curvature = BFGS()
    curvature.initialize(n, "inv_hess")
    return curvature


def _forward(function: Function, x: Tensor, length: float) -> tuple[float, Array]:
    """Return the value and the gradient by forward differences."""
    value = function(x)
    steps = length * torch.eye(len(x), dtype=x.dtype)
    return value, np.array([(function(x + step) - value) / length for step in steps])


def _armijo(function: Function, x: Tensor, value: float, direction: Array, slope: float, noise: float) -> float | None:
    """Return the first of 1, 1/2, 1/4, ... that meets the relaxed Armijo condition, None if no step does."""
    if not np.isfinite(direction).all():
        return None
    length, along = 1.0, torch.from_numpy(direction)
    for _ in range(SHORTENINGS):
        if function(x + length * along) <= value + ARMIJO * length * slope + 2 * noise:
            return length
        length /= 2
    return None
