"""A quadratic through noisy values, and how certain each of its predictions is: Bayesian linear regression."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

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


@dataclass(frozen=True)
class NoisyQuadratic:
    """c + g.u + u.H u/2 for u [n], as coefficients (c, g, upper triangle of H) with their covariance."""

    size: float
    """Unit of the coefficients and of their standard errors: squares of large values would be infinite."""
    coefficients: Tensor
    """[q] with q = (n + 1)(n + 2)/2."""
    covariance: Tensor
    """[q, q]"""
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
    return NoisyQuadratic(size, coefficients, covariance, misfit, n)
