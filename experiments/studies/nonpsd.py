"""How exactly 100 samples give the Hessian of NONPSD, whose convolution is known in closed form.

The source claims for the negated Gaussian -N(0, s1) smoothed with N(0, s2) that "the mean error of our method across
the interval (-3, 3)^2 is within 1e-4 for 100 samples", without s1, s2 or what the mean is taken of. Three readings are
measured over a grid of points, for several s1 and s2, with independent and with Sobol samples:

- signed: the error is averaged over elements and points before its size is taken: a test of bias, in which the noise
  of the points averages out;
- squared: the square of the error of every element is averaged;
- absolute: its size is averaged.

The density is small, so that errors are: at s1 = s2 = 1 the largest element of the true Hessian is 0.04. The relative
error, absolute over the mean size of the true elements, does not depend on that.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.tasks import nonpsd
from experiments.reports.tables import table

CLAIM = 1e-4
READINGS = ("signed", "squared", "absolute")


@dataclass(frozen=True)
class HessianError:
    """Mean errors of the Hessian over the grid, for one pair of widths and one way to sample."""

    s1: float
    s2: float
    sampling: str
    evaluations: int
    signed: float
    """Mean of the errors, its size."""
    signed_noise: float
    """Its standard error, from the spread over the points."""
    squared: float
    """Mean of the squares of the errors."""
    absolute: float
    """Mean of the sizes of the errors."""
    relative: float
    """The same over the mean size of the true elements."""


def nonpsd_error(
    *,
    samples: int = 100,
    grid: int = 61,
    widths: tuple[tuple[float, float], ...] = ((1.0, 0.1), (1.0, 0.5), (1.0, 1.0), (1.0, 2.0), (3.0, 3.0)),
    seed: int = 0,
) -> list[HessianError]:
    """Measure the mean error of the Hessian of NONPSD over (-3, 3)^2.

    Args:
        samples: evaluations of one estimate, in antithetic pairs.
        grid: points along each side.
        widths: pairs of s1 and s2.
        seed: of the perturbations; every point has its own.
    """
    if samples < 4 or samples % 2 or grid < 2:
        raise SystemExit(f"samples must be even and at least 4, grid at least 2, got {samples} and {grid}")
    axis = 3 * (2 * (torch.arange(grid, dtype=torch.float64) + 0.5) / grid - 1)
    points = torch.cartesian_prod(axis, axis)
    errors = [_measure(points, s1, s2, samples, sampler, seed) for s1, s2 in widths for sampler in ("random", "sobol")]
    rows = [
        [
            one.s1,
            one.s2,
            one.sampling,
            one.evaluations,
            f"{one.signed:.1e} +- {one.signed_noise:.0e}",
            f"{one.squared:.1e}",
            f"{one.absolute:.1e}",
            f"{one.relative:.0%}",
            ", ".join(name for name in READINGS if getattr(one, name) <= CLAIM) or "none",
        ]
        for one in errors
    ]
    headers = ["s1", "s2", "sampling", "evaluations", "signed", "squared", "absolute", "relative", f"within {CLAIM:g}"]
    print(f"mean error of the Hessian of -N(0, s1) * N(0, s2) over {grid}x{grid} points of (-3, 3)^2\n")
    print(table(headers, rows))
    print(f"\n{verdict(errors)}")
    return errors


def verdict(errors: Sequence[HessianError]) -> str:
    """Say in which norm the claim of the source holds, and how large the relative error is."""
    counts = [f"{name} in {sum(getattr(one, name) <= CLAIM for one in errors)}" for name in READINGS]
    low, high = (pick(one.relative for one in errors) for pick in (min, max))
    return (
        f"Mean error within {CLAIM:g} of {len(errors)} rows: {', '.join(counts)}. "
        f"Relative error {100 * low:.0f} to {100 * high:.0f} %."
    )


def _measure(
    points: Tensor, s1: float, s2: float, samples: int, sampler: Literal["random", "sobol"], seed: int
) -> HessianError:
    smoothing = zh.Smoothing(sigma=s2, samples=samples // 2, baseline="mean", sampler=sampler, seed=seed)
    estimate = zh.estimate(lambda x: nonpsd.gaussian(x, s1), points, smoothing, value="smoothed")
    truth = torch.func.vmap(torch.func.hessian(lambda x: nonpsd.gaussian(x, math.hypot(s1, s2))))(points)
    error = estimate.hessian() - truth
    mean = error.mean((1, 2))
    return HessianError(
        s1,
        s2,
        sampler,
        estimate.evaluations // len(points),
        abs(float(mean.mean())),
        float(mean.std()) / math.sqrt(len(points)),
        float(error.square().mean()),
        float(error.abs().mean()),
        float(error.abs().mean() / truth.abs().mean()),
    )
