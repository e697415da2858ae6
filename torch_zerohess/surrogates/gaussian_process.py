"""Gaussian process over a few parameters: predicts outputs between evaluations, and how well it knows them.

All elements of an output share one kernel and one variance. A predicted output is therefore a weighted sum of known
outputs, and the weights do not depend on the size of an output. The kernel is a constant plus one of `KERNELS`, joint
or additive. The Gaussian kernel suits smooth functions, and the Matern kernel renders with hard edges. An additive
kernel suits parameters that act each by itself. Structure, kernel, length and noise maximise the evidence, the
likelihood of the outputs (Rasmussen and Williams 2006, section 5.4).

One length serves all parameters of a loss. With outputs of many elements there is enough evidence for more: the length
of each parameter is a power of two times the common one. `ProcessSurrogate` has any length for each parameter.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from torch_zerohess.surrogates.kernels import KERNELS, Kernel, Structure, covariances, separations

LENGTHS = (0.3, 0.5, 1.0, 2.0, 4.0)
"""Length scales, in units of the points."""
NOISES = (1e-6, 1e-3, 1e-2)
"""Noise, the variance of an output that the process does not explain, in units of the process's own variance."""
HIGH_NOISES = (0.1, 1.0, 10.0)
"""Noise of outputs that differ from call to call. A few exact outputs that vary fast look noisy, too."""
CONSTANT = 1.0
"""Variance of the constant part of the kernel."""
_SPREAD = 1.5
"""Standard deviation of the prior over the log of a length."""
_STRETCH, _STRETCHES = 4.0, 2
"""Length of a parameter over the common one, or its inverse, at most; and steps towards it for each parameter."""
DEVIATION_DEGREES = 7
"""Degrees of freedom of a deviation that the caller knows: as many as eight values at one point give."""
_FLAT = 1e-14
"""Change of outputs, relative to their size, that is rounding."""


@dataclass(frozen=True, eq=False)
class Spectra:
    """Eigenvalues and vectors of the covariances of points [P, n], for every structure, kernel and length.

    They are computed once, and serve the evidence of any outputs at these points.
    """

    points: Tensor
    structures: Sequence[Structure] = ("joint",)

    @cached_property
    def decomposed(self) -> tuple[Tensor, Tensor]:
        """Eigenvalues [structures * kernels * lengths, P], and vectors in columns."""
        every = []
        for structure in self.structures:
            separation = separations(structure, self.points, self.points)
            every += [covariances(structure, kernel, separation / length) for kernel in KERNELS for length in LENGTHS]
        values, vectors = torch.linalg.eigh(torch.stack(every) + CONSTANT)
        return values, vectors


@dataclass(frozen=True)
class GaussianProcess:
    """Posterior given outputs [P, m] at points [P, n]; the prediction at x is mean + covariance(x) @ weights."""

    points: Tensor
    structure: Structure
    kernel: Kernel
    length: float
    stretch: Tensor
    """Length of each parameter over `length` [n]."""
    mean: Tensor
    """[m]"""
    weights: Tensor
    """[P, m]"""
    variance: float
    """Of an element of the output, before anything is known."""
    noise: float
    """Variance that the process does not explain, in units of `variance`."""
    factor: Tensor
    """Cholesky factor of the covariance of the points [P, P], with the noise."""

    @classmethod
    def fit(
        cls,
        points: Tensor,
        outputs: Tensor,
        noises: Sequence[float] = NOISES,
        deviation: float | None = None,
        structures: Sequence[Structure] = ("joint",),
        spectra: Spectra | None = None,
        *,
        stretched: bool = False,
    ) -> "GaussianProcess":
        """Choose structure, kernel, length and noise from their lists by the evidence; condition on P >= 2 outputs.

        Args:
            points: [P, n], float64.
            outputs: [P, m], float64.
            noises: levels to choose from.
            deviation: standard deviation of repeated outputs at one point, if it is known.
            structures: of the kernel, to choose from.
            spectra: of the same points and structures, if it is known.
            stretched: whether parameters may have lengths of their own in a joint kernel.
        """
        mean = outputs.mean(0)
        change = outputs - mean
        largest = float(change.abs().max())
        flat = largest <= _FLAT * float(mean.abs().max())
        scale = max(largest, deviation or 0.0)  # neither change nor deviation overflows when it is squared
        relative = None if deviation is None or flat else deviation / scale
        target = torch.zeros_like(change) if flat else change / scale
        spectra = spectra or Spectra(points, structures)
        (structure, kernel, length, noise), variance = _likeliest(spectra, target, noises, relative)
        stretch = torch.ones_like(points[0])
        if stretched and structure == "joint" and len(stretch) > 1 and not flat:
            stretch = _stretch(points, target, kernel, length, noise)
        u = points / stretch
        if not torch.equal(u, points):
            (_, kernel, length, noise), variance = _likeliest(Spectra(u), target, noises, relative)
        variance = 1.0 if flat else scale**2 * variance
        covariance = covariances(structure, kernel, separations(structure, u, u) / length) + CONSTANT
        covariance.diagonal().add_(noise)
        factor = torch.linalg.cholesky(covariance)
        weights = torch.cholesky_inverse(factor) @ change  # of many elements: faster than to solve for each
        return cls(points, structure, kernel, length, stretch, mean, weights, variance, noise, factor)

    def pending(self, x: Tensor) -> "GaussianProcess":
        """Return the process as if its prediction at x [n] had been evaluated.

        Its predictions stay the same; its uncertainty at x falls to the noise. Source: Desautels, Krause and Burdick
        (2014), section 3.2.
        """
        row = torch.linalg.solve_triangular(self.factor, self.covariance(x[None]).mT, upper=False)[:, 0]
        rest = (1.0 + CONSTANT + self.noise - row.square().sum()).clamp_min(self.noise).sqrt()
        factor = torch.nn.functional.pad(self.factor, (0, 1, 0, 1))
        factor[-1, :-1], factor[-1, -1] = row, rest
        weights = torch.nn.functional.pad(self.weights, (0, 0, 0, 1))
        return replace(self, points=torch.cat([self.points, x[None]]), weights=weights, factor=factor)

    def predict(self, x: Tensor) -> Tensor:
        """Expected outputs [Q, m] at points x [Q, n]."""
        return self.mean + self.covariance(x) @ self.weights

    def covariance(self, x: Tensor) -> Tensor:
        """Covariance [Q, P] of points x [Q, n] with the known ones, in units of `variance`."""
        u, known = x / self.stretch, self.points / self.stretch
        separation = separations(self.structure, u, known) / self.length
        return covariances(self.structure, self.kernel, separation) + CONSTANT

    def uncertainty(self, covariance: Tensor) -> Tensor:
        """Variance [Q] of an element of the output, given `covariance` [Q, P]."""
        known = torch.linalg.solve_triangular(self.factor, covariance.mT, upper=False).square().sum(0)
        return self.variance * (1.0 + CONSTANT - known).clamp_min(0.0)


def grid_evidence(
    points: Tensor, change: Tensor, noises: Sequence[float], deviation: float | None = None
) -> tuple[Tensor, Tensor]:
    """Return `spectral_evidence` of points [P, n] for joint kernels."""
    return spectral_evidence(Spectra(points), change, noises, deviation)


def _likeliest(
    spectra: Spectra, change: Tensor, noises: Sequence[float], deviation: float | None
) -> tuple[tuple[Structure, Kernel, float, float], float]:
    """Return structure, kernel, length and noise of the highest `spectral_evidence`, and their variance."""
    evidence, variances = spectral_evidence(spectra, change, noises, deviation)
    best = int(evidence.argmax())
    every = itertools.product(spectra.structures, KERNELS, LENGTHS, noises)
    return next(itertools.islice(every, best, None)), float(variances.flatten()[best])


def _stretch(points: Tensor, change: Tensor, kernel: Kernel, length: float, noise: float) -> Tensor:
    """Return the lengths of the parameters over a common one [n]. One by one is doubled or halved while it is likelier.

    The evidence is that of `spectral_evidence`, and the prior is one for each length.
    """
    P, n = points.shape
    stretch, gram = torch.ones_like(points[0]), change @ change.mT / (P * change.shape[1])
    one = torch.eye(n, dtype=points.dtype, device=points.device)
    factors = 2.0 ** torch.cat([torch.zeros_like(points[:1]), one, -one])  # the first changes nothing
    for _ in range(_STRETCHES * n):
        trials = (stretch * factors).clamp(1.0 / _STRETCH, _STRETCH)
        u = points / (length * trials[:, None])  # [2 n + 1, P, n]
        covariance = covariances("joint", kernel, separations("joint", u, u)) + CONSTANT
        covariance.diagonal(dim1=1, dim2=2).add_(noise)
        factor = torch.linalg.cholesky(covariance)
        variances = (torch.cholesky_inverse(factor) * gram).sum((1, 2)) + math.ulp(0.0)
        logs = 2.0 * factor.diagonal(dim1=1, dim2=2).log().sum(1)
        best = int((-P * variances.log() - logs - improbability(trials).sum(1)).argmax())
        if best == 0:
            break
        stretch = trials[best]
    return stretch


def spectral_evidence(
    spectra: Spectra, change: Tensor, noises: Sequence[float], deviation: float | None = None
) -> tuple[Tensor, Tensor]:
    """Log evidence for every structure, kernel, length and noise, and the most likely variance for each of them.

    The evidence is 2/m times the log likelihood without its constants, plus 2 times the log prior of the length. (An
    output counts as one observation: its elements are not independent.) A known deviation enters as
    `DEVIATION_DEGREES` squares of that size, each of noise alone.

    Args:
        spectra: of the points [P, n].
        change: outputs [P, m] less their mean, at most 1.
        noises: levels [N].
        deviation: of repeated outputs at one point, in the units of `change`; None if it is not known.

    Returns:
        Two tensors [structures * kernels * lengths, N].
    """
    P, m = change.shape
    levels, (values, vectors) = change.new_tensor(noises), spectra.decomposed
    power = (vectors * (change @ change.mT @ vectors)).sum(1).clamp_min(0.0)
    spectrum = values.clamp_min(0.0)[:, None] + levels[:, None]  # [structures x kernels x lengths, N, P]
    squares, logs, count = (power[:, None] / spectrum).sum(2) / m, spectrum.log().sum(2), P
    if deviation is not None:
        squares, logs, count = (
            squares + DEVIATION_DEGREES * deviation**2 / levels,
            logs + DEVIATION_DEGREES * levels.log(),
            P + DEVIATION_DEGREES,
        )
    variances = squares / count + math.ulp(0.0)
    evidence = -count * variances.log() - logs
    evidence -= _priors(spectra)[:, None]
    return evidence, variances


def transformed_evidence(spectra: Spectra, columns: Tensor) -> Tensor:
    """Highest log evidence [T], as in `spectral_evidence`, for each column of values [P, T] alone."""
    P, levels, (values, vectors) = len(columns), columns.new_tensor(NOISES), spectra.decomposed
    power = (vectors.mT @ (columns - columns.mean(0))).square()  # [structures x kernels x lengths, P, T]
    spectrum = values.clamp_min(0.0)[:, None] + levels[:, None]  # [structures x kernels x lengths, N, P]
    variances = spectrum.reciprocal() @ power / P + math.ulp(0.0)
    prior = _priors(spectra)[:, None, None]
    return (-P * variances.log() - spectrum.log().sum(2)[..., None] - prior).flatten(0, 1).amax(0)


def _priors(spectra: Spectra) -> Tensor:
    """Minus 2 times the log prior of the length of each structure, kernel and length."""
    lengths = spectra.points.new_tensor(LENGTHS)
    return improbability(lengths).repeat(len(spectra.structures) * len(KERNELS))


def improbability(lengths: Tensor) -> Tensor:
    """Minus 2 times the log prior of each length."""
    return (lengths.log() / _SPREAD).square()
