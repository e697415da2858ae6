"""Gaussian process over few parameters whose values are outputs: what is known between evaluations, and how well.

All elements of an output share one kernel and one variance, so an output is predicted as a sum of known ones, whatever
its size. The kernel is a constant plus one of `KERNELS`: smooth functions get the Gaussian one, whose smoothed
derivatives exist in closed form, and renders with hard edges, whose loss has a cusp, the Matern one. Kernel, length and
noise are those under which the outputs are most likely (Rasmussen and Williams 2006, section 5.4).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

LENGTHS = (0.3, 0.5, 1.0, 2.0, 4.0)
"""Length scales, in units of the points."""
NOISES = (1e-6, 1e-3, 1e-2)
"""Variances of an output that the process does not explain, in units of its own."""
HIGH_NOISES = (0.1, 1.0, 10.0)
"""The same of outputs that differ from call to call. A few exact ones that vary fast look like that, too."""
_CONSTANT = 1.0
_SPREAD = 1.5
"""Standard deviation of the prior over the log of the length."""


def matern(distance: Tensor) -> Tensor:
    """Matern kernel of order 3/2: once differentiable."""
    scaled = math.sqrt(3.0) * distance
    return (1.0 + scaled) * torch.exp(-scaled)


def gaussian(distance: Tensor) -> Tensor:
    return torch.exp(-0.5 * distance.square())


KERNELS: tuple[Callable[[Tensor], Tensor], ...] = (matern, gaussian)


@dataclass(frozen=True)
class GaussianProcess:
    """Posterior given outputs [P, m] at points [P, n]; the prediction at x is mean + kernel(x) @ weights."""

    points: Tensor
    kernel: Callable[[Tensor], Tensor]
    length: float
    mean: Tensor
    """[m]"""
    weights: Tensor
    """[P, m]"""
    variance: float
    """Of an element of the output, before anything is known."""
    noise: float
    """Variance that the process does not explain, in units of `variance`."""
    factor: Tensor
    """Cholesky factor of the covariance of the points [P, P]."""

    @classmethod
    def fit(cls, points: Tensor, outputs: Tensor, noises: Sequence[float] = NOISES) -> "GaussianProcess":
        """Choose kernel, length and noise by the evidence, and condition on P >= 2 outputs."""
        P, m = outputs.shape
        mean = outputs.mean(0)
        change = outputs - mean
        scale = float(change.abs().max())
        flat = scale <= 1e-14 * float(mean.abs().max())
        unit = change / scale if not flat else torch.zeros_like(change)
        distance = _distance(points, points)
        lengths, levels = distance.new_tensor(LENGTHS), distance.new_tensor(noises)
        scaled = distance / lengths[:, None, None]
        values, vectors = torch.linalg.eigh(torch.cat([kernel(scaled) for kernel in KERNELS]) + _CONSTANT)
        power = (vectors * (unit @ unit.mT @ vectors)).sum(1).clamp_min(0.0)
        spectrum = values.clamp_min(0.0)[:, None] + levels[:, None]  # [kernels x lengths, noises, P]
        variances = (power[:, None] / spectrum).sum(2) / (P * m) + math.ulp(0.0)
        evidence = -P * variances.log() - spectrum.log().sum(2)
        evidence -= (lengths.log() / _SPREAD).square().repeat(len(KERNELS))[:, None]
        shape, level = divmod(int(evidence.argmax()), len(noises))
        kernel, length = KERNELS[shape // len(LENGTHS)], LENGTHS[shape % len(LENGTHS)]
        noise, variance = noises[level], 1.0 if flat else scale**2 * float(variances[shape, level])
        covariance = kernel(distance / length) + _CONSTANT
        covariance.diagonal().add_(noise)
        factor = torch.linalg.cholesky(covariance)
        weights = torch.cholesky_inverse(factor) @ change  # of many elements: faster than to solve for each
        return cls(points, kernel, length, mean, weights, variance, noise, factor)

    def predict(self, x: Tensor) -> Tensor:
        """Expected outputs [Q, m] at points x [Q, n]."""
        return self.mean + self.covariance(x) @ self.weights

    def covariance(self, x: Tensor) -> Tensor:
        """Covariance [Q, P] of points x [Q, n] with the known ones, in units of `variance`."""
        return self.kernel(_distance(x, self.points) / self.length) + _CONSTANT

    def uncertainty(self, covariance: Tensor) -> Tensor:
        """Variance [Q] of an element of the output, given `covariance` [Q, P]."""
        known = torch.linalg.solve_triangular(self.factor, covariance.mT, upper=False).square().sum(0)
        return self.variance * (1.0 + _CONSTANT - known).clamp_min(0.0)


def _distance(a: Tensor, b: Tensor) -> Tensor:
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
