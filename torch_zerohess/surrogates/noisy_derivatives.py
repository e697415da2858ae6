"""Gradient and Hessian at a point from noisy values around it, and how certain they are.

The model is a quadratic with a flat prior, plus a Gaussian process for what is not quadratic (O'Hagan 1978; Rasmussen
and Williams 2006, section 2.7). So the standard errors contain what the quadratic leaves out. The derivatives of the
process are normal, too (Solak et al. 2003).

All kernels, lengths and sizes of the lists are averaged, weighted by their probabilities. With the likeliest choice
alone the standard errors are too small.
"""

import itertools
import math
from collections.abc import Callable
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from torch_zerohess.surrogates.gaussian_process import CONSTANT, DEVIATION_DEGREES
from torch_zerohess.surrogates.inducing import decomposed
from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count, factored, quadratic_terms, symmetric

LENGTHS = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Lengths of the process, in units of the width."""
RATIOS = tuple(10.0**exponent for exponent in range(-6, 7))
"""Variances of the process, in units of the variance of the noise."""
_SPARE = 5
"""Values beyond the coefficients of a quadratic, at least."""
_MOST = 1000
"""Values that are used at a time: at most so many, or twice as many as are needed. Of more every k-th is used."""
_FEATURES = 150
"""Features of the process, at most."""
_UNEXPLAINED = 1e-7
"""Variance of a value that the features may miss, in units of the variance of the process."""
_SHORT = 6.0
"""The prior of a length below 1 is its power with this exponent. A short process below the noise is never seen, but has
large derivatives."""
_LARGE = 0.1
"""The prior of a ratio is its power with minus this exponent: a process is small if the values do not determine its
size."""


T = TypeVar("T")


class _Kernel(NamedTuple):
    """A kernel as a function of the squared distance, and its two derivatives."""

    value: Callable[[Tensor], Tensor]
    first: Callable[[Tensor], Tensor]
    second: Callable[[Tensor], Tensor]


def _root(square: Tensor) -> Tensor:
    return (5.0 * square).sqrt()


KERNELS = (
    _Kernel(
        lambda s: torch.exp(-0.5 * s),
        lambda s: -0.5 * torch.exp(-0.5 * s),
        lambda s: 0.25 * torch.exp(-0.5 * s),
    ),
    _Kernel(  # Matern, twice differentiable
        lambda s: (1.0 + _root(s) + 5.0 / 3.0 * s) * torch.exp(-_root(s)),
        lambda s: -5.0 / 6.0 * (1.0 + _root(s)) * torch.exp(-_root(s)),
        lambda s: 25.0 / 12.0 * torch.exp(-_root(s)),
    ),
)


class _Choices(NamedTuple):
    """What C choices of kernel, length and size tell of value, gradient, upper triangle of the Hessian, changes [q]."""

    evidence: Tensor
    """Log probability [C], up to a constant."""
    means: Tensor
    """[C, q]"""
    variances: Tensor
    """[C, q]"""


class _Told(NamedTuple):
    """What values around x tell."""

    model: LocalModel
    """In units of the width."""
    width: Tensor
    """[n]"""
    changes: Tensor
    """Values at other points less the value at x [C]."""
    errors: Tensor
    """Of the changes [C]."""


def noisy_derivatives(x: Tensor, points: Tensor, values: Tensor, noise: float) -> tuple[LocalModel, Tensor] | None:
    """Return value, gradient and Hessian at x with their standard errors, and the width of the points behind them.

    Args:
        x: [n].
        points: evaluations [P, n], float64.
        values: their losses [P]; points whose loss is not finite are left out.
        noise: standard deviation of repeated losses at one point.

    Of all values, the nearest half, the nearest quarter and so on, those with the least error of the Hessian are
    used: one size of the process does not suit values that grow fast.

    Returns:
        The quadratic around x in units of the width, and the width [n], the mean distance along every parameter; None
        if the points do not determine a quadratic.
    """
    told = _told(x, points, values, noise, x[None][:0])
    return None if told is None else told[:2]


def noisy_changes(
    x: Tensor, others: Tensor, points: Tensor, values: Tensor, noise: float
) -> tuple[Tensor, Tensor] | None:
    """Return the values at other points [C, n] less the value at x, [C], and the standard errors [C]; or None.

    The arguments are those of `noisy_derivatives`, and so are the evaluations that tell.
    """
    told = _told(x, points, values, noise, others)
    return None if told is None else told[2:]


def _told(x: Tensor, points: Tensor, values: Tensor, noise: float, others: Tensor) -> _Told | None:
    """Return what values tell around x [n], by the part of them that has the least error of the Hessian."""
    finite = torch.isfinite(values)
    steps, values = points[finite] - x, values[finite]

    def fitted(near: Tensor, width: Tensor) -> tuple[LocalModel, _Told] | None:
        told = _model(steps[near] / width, values[near], noise, (others - x) / width)
        return None if told is None else (told[0], _Told(told[0], width, *told[1:]))

    return most_certain(steps, fitted)


def most_certain(steps: Tensor, fitted: Callable[[Tensor, Tensor], tuple[LocalModel, T] | None]) -> T | None:
    """Fit to all evaluations, to the nearest half, and so on; return what has the least error of the Hessian.

    Args:
        steps: to the evaluations [P, n].
        fitted: numbers of evaluations and their width [n] to a quadratic and what is returned; None if they do not
            determine a quadratic.
    """
    unit, least = mean_length(steps), coefficient_count(steps.shape[1]) + _SPARE
    order = (steps / unit).norm(dim=1).argsort(stable=True)
    found, count, most = [], len(order), max(_MOST, 2 * least)
    while count >= least:
        near = order[:count][:: math.ceil(count / most)]
        width = mean_length(steps[near])
        fit = fitted(near, width)
        if fit is not None:
            found.append((float((fit[0].curvature_error * (unit / width).square()).norm()), fit[1]))
        count //= 2
    best = min((one for one in found if math.isfinite(one[0])), key=lambda one: one[0], default=None)
    return None if best is None else best[1]


def mean_length(steps: Tensor) -> Tensor:
    """Return the mean length [n] of steps [P, n] along every parameter; 1 where there are none."""
    mean = steps.abs().mean(0)
    return torch.where(mean > 0.0, mean, torch.ones_like(mean))


def _model(u: Tensor, values: Tensor, noise: float, others: Tensor) -> tuple[LocalModel, Tensor, Tensor] | None:
    """Return the quadratic around 0 given values [P] at u [P, n]; None if they do not determine one.

    And the changes of the value from 0 to others [C, n] with their standard errors.
    """
    largest, n = float(values.abs().max()) or 1.0, u.shape[1]
    values, noise = values / largest, noise / largest  # differences of the largest numbers overflow
    base = values.median()
    spread = float((values - base).abs().max())
    size = max(spread, noise)  # neither the square of a change nor that of the noise overflows
    choices = _choices(u, (values - base) / size, noise / size, others) if spread > 0.0 else None
    if choices is None:
        return None
    weights = choices.evidence.softmax(0)
    mean = weights @ choices.means
    error = (weights @ (choices.variances + (choices.means - mean).square())).sqrt()
    mean, error = largest * (size * mean), largest * (size * error)
    q = coefficient_count(n)
    slope, bend = error[1 : n + 1], symmetric(error[n + 1 : q], n).diagonal()
    value = largest * float(base) + float(mean[0])
    model = LocalModel(value, mean[1 : n + 1], symmetric(mean[n + 1 : q], n), None, slope, bend)
    return model, mean[q:], error[q:]


def _choices(u: Tensor, change: Tensor, noise: float, others: Tensor) -> _Choices | None:
    """Return what all choices tell at u = 0, given change [P] at u [P, n]; None if u does not determine a quadratic.

    And of the changes from there to others [C, n].

    For each kernel and length the process is a sum of features with independent normal weights. The flat prior of the
    quadratic takes its part out of features and values (restricted likelihood). The eigenvectors of what is left serve
    all sizes of the process.
    """
    factors = sought_terms(u, others)
    if factors is None:
        return None
    orthonormal, sought = factors
    quadratic = sought @ (orthonormal.mT @ change)
    rest = change - orthonormal @ (orthonormal.mT @ change)
    known = DEVIATION_DEGREES * noise**2
    degrees = len(u) - orthonormal.shape[1] + DEVIATION_DEGREES
    ratios = u.new_tensor(RATIOS)[:, None]
    found = []
    for kernel, length in itertools.product(KERNELS, LENGTHS):
        features, derivatives, missed = process_features(u, kernel, length, others)
        part = sought @ (orthonormal.mT @ features)
        spread, axes = torch.linalg.eigh((features - orthonormal @ (orthonormal.mT @ features)).mT @ features)
        pulled = axes.mT @ (features.mT @ rest)
        widened = 1.0 + ratios * spread.clamp_min(0.0)  # [ratios, M]
        shrunk = ratios / widened
        squares = rest.square().sum() - shrunk @ pulled.square() + known
        variances = squares.clamp_min(torch.finfo(u.dtype).tiny * degrees) / degrees
        evidence = -0.5 * (degrees * variances.log() + widened.log().sum(1))
        evidence += log_prior(length, ratios[:, 0])
        tilt = (derivatives - part) @ axes  # [q, M]
        means = quadratic + (shrunk * pulled) @ tilt.mT
        certain = sought.square().sum(1) + shrunk @ tilt.square().mT + ratios * missed
        found.append(_Choices(evidence, means, variances[:, None] * certain))
    return _Choices(*(torch.cat(one) for one in zip(*found, strict=True)))


def sought_terms(u: Tensor, others: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return Q [P, q] and S [q + C, q] of a quadratic through values y at u [P, n]; None if u does not determine one.

    S Q^T y are the q coefficients of the quadratic at 0, and its changes from there to others [C, n].
    """
    factors = factored(quadratic_terms(u))
    if factors is None:
        return None
    orthonormal, inverse = factors
    steps = quadratic_terms(others)
    steps[:, 0] = 0.0
    return orthonormal, torch.cat([inverse, steps @ inverse])


def log_prior(length: float, ratios: Tensor) -> Tensor:
    """Return the log of the prior of a process with a length and variances [R] in units of the noise."""
    return _SHORT * math.log(min(length, 1.0)) - _LARGE * ratios.log()


def process_features(u: Tensor, kernel: _Kernel, length: float, others: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Decompose a process of variance 1 (plus a constant) into features, at most as many as there are points.

    Returns:
        The features at u [P, M]; their value, gradient and upper triangle of the Hessian at 0, and their changes from
        there to others [C, n], [q, M]; and the variances of these [q] that the features miss.
    """
    n = u.shape[1]
    features, chosen = decomposed(u / length, lambda d: kernel.value(d.square()), _UNEXPLAINED, _FEATURES)
    to = u[chosen] / length
    square = to.square().sum(1)
    first, second = kernel.first(square), kernel.second(square)
    row, column = torch.triu_indices(n, n, device=u.device)
    same = (row == column).to(u)
    bends = 4.0 * second * (to[:, row] * to[:, column]).mT + 2.0 * first * same[:, None]
    moves = others / length
    between = kernel.value((moves[:, None] - to).square().sum(2)) - kernel.value(square)
    covariance = torch.cat([CONSTANT + kernel.value(square)[None], -2.0 * first * to.mT, bends, between])
    slope, bend = kernel.first(u.new_zeros(1)), kernel.second(u.new_zeros(1))
    apart = 2.0 - 2.0 * kernel.value(moves.square().sum(1))
    curved = 4.0 * bend * (1.0 + 2.0 * same)
    prior = torch.cat([u.new_full((1,), CONSTANT + 1.0), -2.0 * slope.expand(n), curved, apart])
    units = length ** torch.cat([u.new_zeros(1), u.new_ones(n), torch.full_like(same, 2.0), torch.zeros_like(apart)])
    derivatives = torch.linalg.solve_triangular(features[chosen].tril(), covariance.mT, upper=False).mT
    missed = (prior - derivatives.square().sum(1)).clamp_min(0.0)
    return features, derivatives / units[:, None], missed / units.square()
