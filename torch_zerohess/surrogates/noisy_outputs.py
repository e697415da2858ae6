"""Derivatives of a loss of noisy outputs at a point, from a regression of the outputs around it.

Every number of the output has a model as in `noisy_derivatives`: a quadratic with a flat prior, plus a Gaussian
process. Kernel, length and size of the process are the likeliest ones for all numbers together.

The standard errors take errors of the numbers as independent. Outputs that bend in the same way err together, so the
standard errors may be half of the true ones.
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.surrogates import noisy_derivatives as of_losses
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count, symmetric


@dataclass(frozen=True)
class _Outputs:
    """Outputs around 0: of a quadratic and a process, at 0 and at C other points."""

    terms: Tensor
    """Value, slopes and upper triangles of the Hessians at 0, and changes from there to others, [q + C, m]."""
    certain: Tensor
    """Variances of the terms [q + C], in units of the variance of a number."""
    variance: Tensor
    """Of the noise of each number [m]."""


@dataclass(frozen=True)
class OutputRegression:
    """A loss of noisy outputs at points, which a regression predicts at any other point.

    Args:
        points: evaluations [P, n], float64.
        outputs: [P, m], float64, all finite.
        loss: of an output.
        shape: of an output.
    """

    points: Tensor
    outputs: Tensor
    loss: Callable[[Tensor], Tensor]
    shape: torch.Size

    def derivatives(self, x: Tensor) -> tuple[LocalModel, Tensor] | None:
        """Return the quadratic of the loss around x [n], and the width [n] of the evaluations, its unit; or None."""
        found = self._around(x, x[None][:0])
        return None if found is None else found[:2]

    def change(self, x: Tensor, other: Tensor) -> tuple[float, float] | None:
        """Return the loss at another point [n] less the loss at x [n], and the standard error; or None."""
        found = self._around(x, other[None])
        if found is None:
            return None
        here, there = found[2].terms[0], found[2].terms[0] + found[2].terms[-1]
        one, two = (loss_curvature(self.loss, y.view(self.shape)) for y in (here, there))
        slope, known = two.slope.flatten(), found[2]
        by_change = known.certain[-1] * (known.variance @ slope.square())
        by_value = known.certain[0] * (known.variance @ (slope - one.slope.flatten()).square())
        return two.value - one.value, math.sqrt(float(by_change + by_value))

    def _around(self, x: Tensor, others: Tensor) -> tuple[LocalModel, Tensor, _Outputs] | None:
        """Return what the nearest evaluations, or more of them, tell: those with the least error of the Hessian."""
        steps = self.points - x

        def fitted(near: Tensor, width: Tensor) -> tuple[LocalModel, tuple[LocalModel, Tensor, _Outputs]] | None:
            outputs = _fitted(steps[near] / width, self.outputs[near], (others - x) / width)
            if outputs is None:
                return None
            model = self._quadratic(outputs, len(x))
            return model, (model, width, outputs)

        return of_losses.most_certain(steps, fitted)

    def _quadratic(self, known: _Outputs, n: int) -> LocalModel:
        """Return the quadratic of the loss at 0."""
        q = coefficient_count(n)
        output, jacobian, bends = known.terms[0], known.terms[1 : n + 1], known.terms[n + 1 : q]
        expanded = loss_curvature(self.loss, output.view(self.shape))
        slope = expanded.slope.flatten()
        inner = expanded.products(jacobian.view(n, *self.shape))
        hessian = jacobian @ inner.mT
        hessian = 0.5 * (hessian + hessian.mT) + symmetric(bends @ slope, n)
        along, across = known.variance @ slope.square(), inner.square() @ known.variance
        slopes, bent = known.certain[1 : n + 1], symmetric(known.certain[n + 1 : q], n).diagonal()
        error = (slopes * along + known.certain[0] * across).sqrt()
        bend = (bent * along + 4.0 * slopes * across).sqrt()
        return LocalModel(expanded.value, jacobian @ slope, hessian, None, error, bend)


def _fitted(u: Tensor, outputs: Tensor, others: Tensor) -> _Outputs | None:
    """Fit outputs [P, m] at u [P, n]; None if u does not determine a quadratic. Others [C, n]."""
    factors = of_losses.sought_terms(u, others)
    if factors is None:
        return None
    orthonormal, sought = factors
    base = outputs.mean(0)
    change = outputs - base
    size = float(change.abs().max()) or 1.0
    change = change / size
    projected = orthonormal.mT @ change
    rest = change - orthonormal @ projected
    degrees, (_, m) = len(u) - orthonormal.shape[1], change.shape
    ratios = u.new_tensor(of_losses.RATIOS)[:, None]
    total, found = rest.square().sum(0), []
    for kernel, length in itertools.product(of_losses.KERNELS, of_losses.LENGTHS):
        features, derivatives, missed = of_losses.process_features(u, kernel, length, others)
        part = orthonormal.mT @ features
        spread, axes = torch.linalg.eigh((features - orthonormal @ part).mT @ features)
        pulled = axes.mT @ (features.mT @ rest)
        widened = 1.0 + ratios * spread.clamp_min(0.0)
        shrunk = ratios / widened
        least = torch.finfo(u.dtype).tiny * degrees * m
        squares = (total.sum() - shrunk @ pulled.square().sum(1)).clamp_min(least)
        evidence = -0.5 * m * (degrees * (squares / (degrees * m)).log() + widened.log().sum(1))
        evidence += of_losses.log_prior(length, ratios[:, 0])
        k = int(evidence.argmax())
        tilt = (derivatives - sought @ part) @ axes
        found.append((float(evidence[k]), k, pulled, shrunk[k], tilt, missed))
    _, k, pulled, shrunk, tilt, missed = max(found, key=lambda one: one[0])
    terms = sought @ projected + tilt @ (shrunk[:, None] * pulled)
    terms[0] += base / size
    certain = sought.square().sum(1) + tilt.square() @ shrunk + ratios[k, 0] * missed
    variance = (total - shrunk @ pulled.square()).clamp_min(torch.finfo(u.dtype).tiny) / degrees
    return _Outputs(size * terms, certain, size**2 * variance)
