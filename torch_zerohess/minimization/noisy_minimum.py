"""The minimum of a noisy loss from all evaluations together: where it is, its value, and the standard error of that."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.surrogates.gaussian_process import HIGH_NOISES, NOISES, GaussianProcess

_MOST = 100
"""Evaluations that are used, the nearest ones."""
_FINE_NOISES = (1e-8, 1e-7, 1e-5, 1e-4, 3e-4, 3e-3, 3e-2, 0.3, 3.0)
"""Further levels of noise: losses far from the minimum may be thousands of times the noise."""


class Lowest(NamedTuple):
    """A point [n] that was evaluated, the loss without noise that is expected there, and its standard error."""

    x: Tensor
    value: float
    error: float


def lowest(points: Tensor, losses: Tensor, start: Tensor) -> Lowest:
    """Return the evaluation with the lowest finite loss; the first one if none is finite, the start if there is none.

    Args:
        points: evaluations [P, n].
        losses: [P].
        start: [n], whose value is not known: NaN.
    """
    if not len(losses):
        return Lowest(start, math.nan, 0.0)
    k = int(torch.where(torch.isfinite(losses), losses, torch.inf).argmin())
    return Lowest(points[k].clone(), float(losses[k]), 0.0)


def expected_minimum(points: Tensor, losses: Tensor, around: Tensor, unit: Tensor, noise: float) -> Lowest:
    """Return the evaluated point with the lowest expected loss, by a Gaussian process of the evaluations.

    Every candidate was evaluated, so a value without an evaluation near it is never returned. The expectation uses the
    other evaluations, too, so the luckiest draw is not returned for its luck. (Some luck is left: with few evaluations
    the value is too low by half a standard error on average.)

    Args:
        points: evaluations [P, n].
        losses: their values [P]; those that are not finite are left out, and one must be finite.
        around: the nearest evaluations to this point [n] are used.
        unit: the scale of every parameter [n].
        noise: standard deviation of repeated losses at one point; evaluations that differ by more count as well.
    """
    finite = torch.isfinite(losses)
    points, losses, unit = points[finite], losses[finite], unit.double()
    z = (points.double() - around.double()) / unit
    distance, order = z.square().mean(1).sqrt().sort(stable=True)
    near = order[:_MOST]
    points, values, z = points[near], losses[near].to(unit), z[near]
    reach = float(distance[: len(near)].square().mean().sqrt())
    if bool((z == z[0]).all() or (values == values[0]).all()):  # all are of one point, or none is lower than another
        return Lowest(points[0], float(values.mean()), noise / math.sqrt(len(values)))
    z = z / (reach * math.sqrt(len(unit)))
    size = max(float(values.abs().max()), noise)  # the squares of values / size and noise / size do not overflow
    process = GaussianProcess.fit(z, values[:, None] / size, (*NOISES, *_FINE_NOISES, *HIGH_NOISES), noise / size)
    expected = process.predict(z)[:, 0]
    k = int(expected.argmin())
    error = float(process.uncertainty(process.covariance(z[k : k + 1])).sqrt())
    return Lowest(points[k], size * float(expected[k]), size * error)
