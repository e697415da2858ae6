"""A quadratic through noisy values, and how certain each of its predictions is: Bayesian linear regression.

A quadratic of a few parameters cannot follow losses that grow a hundred times as fast on one side of the minimum as on
the other. It can follow warped losses better: equal to the losses where they are low, and a logarithm beyond. The
likelihood says which losses it follows better (`fit_losses`).
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.surrogates.loss_transform import warped
from torch_zerohess.surrogates.quadratic import quadratic_terms, symmetric

_CURVED = 2.0
"""Prior standard deviation of a change of curvature, over the variation of the values."""
_FLAT = 10.0
"""Prior standard deviation of the constant and of a slope, over that of a curvature."""
_LOOKS = 3
"""Times that the variance of the values and the coefficients are estimated from each other."""
_PARAMETERS = 0.7
"""Share of the values that a quadratic fits by itself, where there are fewer values than coefficients."""
_UNLIKELY = 2.0
"""Standard deviations of the mean squared residual by which it is larger than the noise in a misfit."""
_UNSURE = 2.0
"""Factor by which the variance of the noise may be larger than given: eight values measure it no better."""
_UNIT, _BELOW = 30.0, 2.0
"""Unit of warped losses, and how far the lowest one is below its mean, over the noise."""
_LEAST = 1e-300
"""Noise over the largest loss, at which losses over the noise overflow."""
_HIGHEST = 50.0
"""Warped loss at the center over the unit, at most."""


@dataclass(frozen=True)
class NoisyQuadratic:
    """c + g.u + u.H u/2 for u [n], as coefficients (c, g, upper triangle of H) with their covariance."""

    size: float
    """Unit of the coefficients and of their standard errors: squares of large values would be infinite."""
    coefficients: Tensor
    """[q] with q = (n + 1)(n + 2)/2."""
    covariance: Tensor
    """[q, q]"""
    variance: float
    """Of a value, in units of the square of `size`: that of the noise, or the mean squared residual."""
    misfit: bool
    """Whether residuals are larger than the noise."""
    n: int

    @property
    def value(self) -> float:
        """At u = 0."""
        return self.size * float(self.coefficients[0])

    @property
    def gradient(self) -> Tensor:
        """At u = 0, [n]."""
        return self.size * self.coefficients[1 : 1 + self.n]

    @property
    def hessian(self) -> Tensor:
        """[n, n]"""
        return symmetric(self.size * self.coefficients[1 + self.n :], self.n)

    @property
    def errors(self) -> Tensor:
        """Standard errors of c, g and the upper triangle of H, [q]."""
        return self.size * self.covariance.diagonal().clamp_min(0.0).sqrt()

    def change(self, u: Tensor) -> tuple[float, float]:
        """Return the value at u [n] less the value at 0, and its standard error."""
        terms = quadratic_terms(u[None])[0]
        terms[0] = 0.0
        error = math.sqrt(max(float(terms @ self.covariance @ terms), 0.0))
        return self.size * float(terms @ self.coefficients), self.size * error


def fit_noisy(u: Tensor, values: Tensor, weights: Tensor, noise: float, before: Tensor) -> NoisyQuadratic:
    """Fit a quadratic to values [P] at u [P, n], for any P >= 1.

    The prior of the Hessian is normal around `before`, and nearly flat in the constant and the slopes. The variance of
    a value is the square of the noise, or the mean squared residual if the residual is larger. The fit has a misfit if
    the mean squared residual is significantly larger than the noise.

    Args:
        u: points.
        values: at the points.
        weights: of the values, [P], at most 1.
        noise: standard deviation of a value.
        before: Hessian that is expected [n, n].
    """
    n, size = u.shape[1], max(float(values.abs().max()), noise) or 1.0
    values, noise, before = values / size, noise / size, before / size  # their squares do not overflow
    terms = quadratic_terms(u)
    middle = values.median()
    spread = float((values - middle).abs().median()) + noise + math.ulp(1.0)
    i, j = torch.triu_indices(n, n, device=u.device)
    expected = torch.cat([values.new_zeros(1 + n), before[i, j]])
    expected[0] = middle
    prior = torch.full_like(expected, _CURVED * spread)
    prior[: 1 + n] *= _FLAT
    count = float(weights.sum())
    degrees = max(count - min(len(expected), _PARAMETERS * count), 1.0)
    scaled, rest = terms * prior, values - terms @ expected
    told, axes = torch.linalg.eigh((scaled.mT * weights) @ scaled)  # what the values tell of combinations
    told = told.clamp_min(0.0)
    rounding = torch.finfo(told.dtype).eps * len(told) * float(told[-1])  # of the smallest ones
    least = max(noise**2, rounding)
    variance, pulled = least, axes.mT @ (scaled.mT @ (weights * rest))
    for _ in range(_LOOKS):
        coefficients = expected + prior * (axes @ (pulled / (variance + told)))
        residual = float(weights @ (values - terms @ coefficients).square()) / degrees
        variance = max(least, residual)
    axes = prior[:, None] * axes
    covariance = (axes * (variance / (variance + told))) @ axes.mT
    misfit = residual > _UNSURE * least * (1.0 + _UNLIKELY * math.sqrt(2.0 / degrees))
    return NoisyQuadratic(size, coefficients, covariance, variance, misfit, n)


def fit_losses(u: Tensor, losses: Tensor, weights: Tensor, noise: float, before: Tensor) -> NoisyQuadratic:
    """Fit a quadratic to losses [P] at u [P, n], or to warped losses if they are likelier. Arguments as in `fit_noisy`.

    Slopes and curvatures are those of the warped losses: their steps lead to the same minimum. The value is a loss.
    """
    plain = fit_noisy(u, losses, weights, noise, before)
    if not plain.misfit or noise <= _LEAST * plain.size:
        return plain
    unit, lowest = _UNIT * noise, float(losses.min()) + _BELOW * noise
    values, slopes = warped(losses - lowest, unit)
    fit = fit_noisy(u, values, weights, noise, before)
    if not _likelihood(fit, weights) + 2.0 * float(weights @ slopes.log()) > _likelihood(plain, weights):
        return plain  # also where values overflow
    value = min(max(fit.value / unit, -_HIGHEST), _HIGHEST)
    coefficients, factor = fit.coefficients.clone(), torch.ones_like(fit.coefficients)
    coefficients[0] = (lowest + unit * math.sinh(value)) / fit.size
    factor[0] = math.cosh(value)  # the slope of the loss by the warped one
    return replace(fit, coefficients=coefficients, covariance=factor[:, None] * fit.covariance * factor)


def _likelihood(fit: NoisyQuadratic, weights: Tensor) -> float:
    """Return twice the log likelihood of the values that were fitted, without its constants."""
    return -float(weights.sum()) * (math.log(fit.variance) + 2.0 * math.log(fit.size))
