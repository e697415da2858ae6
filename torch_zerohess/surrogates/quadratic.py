"""Quadratic models of a black box around a point, by regression on evaluations in its neighbourhood.

Let u = (z - x)/sigma. Gradient and Hessian of the smoothed function are the Hermite coefficients of degree 1 and 2 of
u -> f(x + sigma u) under the normal density. A weighted least-squares fit estimates them, also from evaluations that
were made around other points (see `Pool`). Both models live in the span of the perturbations: with fewer evaluations
than parameters they know nothing of the other directions, and a step does not go there.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.surrogates.loss_curvature import loss_curvature

_NOISE = (1e-7, 1e-4, 1e-2, 1e-1)
"""Variances of the part of the values that is not quadratic, in units of the prior's; the evidence chooses."""
_CONSTANT = 10.0
"""Prior variance of the constant term."""
_RIDGES = (1e-6, 1e-3, 0.2)
"""Prior precisions of a slope, in evaluations; the evidence chooses."""
_ROUNDING = 1e-15
"""Variation of values, relative to their size, that is rounding: the values are constant."""
_INTERCEPT = 1e-9
"""Prior precision of the constant term of an output, in evaluations."""
_RANK = 1e-9
"""Smallest pivot of the terms of a quadratic, relative to the largest, with which points determine all its
coefficients."""
_JITTER = 1e-13
"""Added to a kernel matrix, in units of its mean diagonal element, so that rounding leaves it definite."""


@dataclass(frozen=True)
class LocalModel:
    """value + gradient.s + s.hessian s/2 of s = basis^T u [r], in units of sigma."""

    value: float
    gradient: Tensor
    """[r]"""
    hessian: Tensor
    """[r, r]"""
    basis: Tensor | None
    """Orthonormal [n, r]; None for the identity."""
    gradient_error: Tensor
    """Standard error of the gradient [r]."""
    curvature_error: Tensor
    """Standard error of the diagonal of the Hessian [r]."""
    significance: float = math.inf
    """log(evidence of the model / evidence of a constant): below 0 the values may as well be noise."""
    intercept: Tensor | None = None
    """Output at u = 0, [m]."""
    jacobian: Tensor | None = None
    """Of the outputs, [r, m]."""

    @property
    def rank(self) -> int:
        return len(self.gradient)

    def full_gradient(self) -> Tensor:
        """Gradient for u [n]; zero outside of the span."""
        return self.expand(self.gradient)

    def full_hessian(self) -> Tensor:
        """Hessian for u [n, n]; zero outside of the span."""
        return self.hessian if self.basis is None else self.basis @ self.hessian @ self.basis.mT

    def full_errors(self) -> tuple[Tensor, Tensor]:
        """Standard errors of gradient [n] and Hessian diagonal [n]; infinite if there are directions outside."""
        if self.basis is None:
            return self.gradient_error, self.curvature_error
        unknown = torch.full_like(self.basis[:, 0], math.inf)
        return unknown, unknown.clone()

    def reduce(self, u: Tensor) -> Tensor:
        """Coordinates [r] of a perturbation u [n]."""
        return u if self.basis is None else self.basis.mT @ u

    def expand(self, s: Tensor) -> Tensor:
        """Perturbation [n] of coordinates s [r]."""
        return s if self.basis is None else self.basis @ s

    def decrease(self, s: Tensor) -> float:
        """Decrease of the model from 0 to s [r]."""
        return -float(self.gradient @ s + 0.5 * (s @ self.hessian @ s))

    def misfit(self, s: Tensor, output: Tensor) -> float:
        """Squared error of the predicted output [m] at s [r], over the squared change that was predicted."""
        assert self.intercept is not None
        assert self.jacobian is not None
        change = s @ self.jacobian
        error = float((output - self.intercept - change).square().sum())
        return error / max(float(change.square().sum()), math.ulp(0.0))


def coefficient_count(n: int) -> int:
    """Return the number of coefficients of a quadratic in n parameters."""
    return (n + 1) * (n + 2) // 2


def quadratic_terms(u: Tensor) -> Tensor:
    """Return what the coefficients of c + g.u + u.H u/2 are multiplied with at u [P, n], [P, q].

    The coefficients are c, g and the upper triangle of H, row by row.
    """
    row, column = torch.triu_indices(u.shape[1], u.shape[1], device=u.device)
    products = u[:, row] * u[:, column]
    return torch.cat([torch.ones_like(u[:, :1]), u, torch.where(row == column, 0.5 * products, products)], 1)


def factored(terms: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return Q [P, q] and R^-1 [q, q] of terms = Q R [P, q]; None if the points do not determine every coefficient."""
    q, r = torch.linalg.qr(terms)
    pivots = r.diagonal().abs()
    if float(pivots.min()) < _RANK * float(pivots.max()):
        return None
    one = torch.eye(len(r), dtype=r.dtype, device=r.device)
    return q, torch.linalg.solve_triangular(r, one, upper=True)


def symmetric(upper: Tensor, n: int) -> Tensor:
    """Return the symmetric matrix [n, n] with these numbers in its upper triangle, row by row."""
    row, column = torch.triu_indices(n, n, device=upper.device)
    matrix = upper.new_zeros(n, n)
    matrix[row, column] = matrix[column, row] = upper
    return matrix


def fit_values(u: Tensor, values: Tensor, weights: Tensor) -> LocalModel:
    """Fit a quadratic to values [P] at u [P, n] with weights [P], for any P >= 1 and n.

    Kernel ridge regression with the kernel 10 + u.u'/n + (u.u')^2/2n^2 + (|u|^2-n)(|u'|^2-n)/4n^2. This is a Gaussian
    prior over slopes, over all entries of the Hessian and over its trace: a few evaluations in many dimensions still
    give the mean curvature. P numbers describe the Hessian, whatever n. Where P is large it is a full one, otherwise
    one of low rank plus a multiple of the identity. The evidence (marginal likelihood) chooses the variance of the
    part that is not quadratic, from exact interpolation to noise.
    """
    n = u.shape[1]
    basis, s = _reduced(u)
    flat = float(values.max() - values.min()) <= _ROUNDING * float(values.abs().max())
    mean = values[0] if flat else values[0] + weights @ (values - values[0]) / weights.sum()
    change = torch.zeros_like(values) if flat else values - mean
    largest = float(change.abs().max()) or 1.0
    scale = largest * (weights @ (change / largest).square() / weights.sum()).sqrt() + math.ulp(0.0)
    root, inner, trace = weights.sqrt(), s @ s.mT, s.square().sum(1) - n
    target = root * change / scale
    kernel = _CONSTANT + inner / n + (0.5 * inner.square() + 0.25 * trace[:, None] * trace) / n**2
    fits = [_Evidence.of(kernel, noise, root, target) for noise in _NOISE]
    best = max(fits, key=lambda fit: fit.log)
    constant = _Evidence.of(torch.full_like(kernel, _CONSTANT), 1.0, root, target)
    alpha, spread = root * best.solution, float(scale) * math.sqrt(best.variance)
    gradient = s.mT @ alpha / n
    identity = torch.eye(s.shape[1], dtype=s.dtype, device=s.device)
    hessian = ((s.mT * alpha) @ s + 0.5 * (alpha @ trace) * identity) / n**2
    # Posterior variances: the prior one less what the evaluations determine.
    known = best.whiten(root[:, None] * s / n).square().sum(0)
    bent = best.whiten(root[:, None] * (s.square() + 0.5 * trace[:, None]) / n**2).square().sum(0)
    # The prior knows one size of curvature for all parameters. Fewer evaluations than coefficients determine no more.
    told = len(u) >= coefficient_count(n)
    unknown = torch.full_like(bent, math.inf)
    at_zero = _CONSTANT * alpha.sum() - 0.25 * (alpha @ trace) / n
    return LocalModel(
        float(mean + scale * at_zero),
        scale * gradient,
        scale * hessian,
        basis,
        spread * (1.0 / n - known).clamp_min(0.0).sqrt(),
        spread * (3.0 / n**2 - bent).clamp_min(0.0).sqrt() if told else unknown,
        -math.inf if flat else best.log - constant.log,
    )


def fit_outputs(
    u: Tensor,
    outputs: Tensor,
    weights: Tensor,
    loss: Callable[[Tensor], Tensor],
    shape: torch.Size,
    damping: float = 0.0,
) -> LocalModel:
    """Fit outputs [P, m] linearly at u [P, n]; return the quadratic model of `loss` after them (Gauss-Newton).

    The intercept is the smoothed output M = E f(x + sigma u), the slopes are its Jacobian J [n, m]. The model of the
    loss has the gradient J grad(loss)(M) and the Hessian J loss''(M) J^T. It smooths the output, loss(E f), not the
    loss, E loss(f). `loss` takes an output of the given `shape`. Derivatives of the loss that are not finite, such as
    the derivative of a norm at zero, count as zero. `damping` times the mean curvature is added to the curvature.
    """
    P, _ = u.shape
    basis, s = _reduced(u)
    r = s.shape[1]
    design = torch.cat([s.new_ones(P, 1), s], 1)
    gram = design.mT @ (weights[:, None] * design)
    gram.diagonal()[0] += _INTERCEPT
    gram.diagonal()[1:] += _ridge(s, outputs, weights)
    inverse = torch.cholesky_inverse(torch.linalg.cholesky(gram))
    slopes = inverse @ (design.mT @ (weights[:, None] * outputs))
    intercept, jacobian = slopes[0], slopes[1:]
    expanded = loss_curvature(loss, intercept.view(shape))
    downhill, bend = expanded.slope.flatten(), expanded.products(jacobian.view(r, *shape))
    gradient = jacobian @ downhill
    hessian = jacobian @ bend.mT
    hessian = 0.5 * (hessian + hessian.mT)
    hessian.diagonal().add_(damping * hessian.diagonal().abs().mean())
    spare = P - r - 1
    missed = outputs - design @ slopes
    own = inverse.diagonal()[1:] if spare > 0 else torch.full_like(gradient, math.inf)

    def error(directions: Tensor) -> Tensor:
        """Return the standard errors [r] of J times directions [*, m].

        What the linear fit misses is curved, so it does not average out over the evaluations. Errors of the outputs may
        add up, or be independent of each other: the larger estimate counts.
        """
        coherent = weights @ (missed @ directions.mT).square()
        single = (weights @ missed.square()) @ directions.square().mT
        missing = torch.maximum(coherent, single).clamp_min(math.ulp(0.0))  # infinity times zero is no number
        return (own * missing * (P / max(spare, 1))).sqrt().clamp_min(math.ulp(0.0))

    return LocalModel(
        expanded.value,
        gradient,
        hessian,
        basis,
        error(downhill[None]),
        2.0 * error(bend),
        intercept=intercept,
        jacobian=jacobian,
    )


@dataclass(frozen=True)
class _Evidence:
    """One kernel ridge regression: its solution and the log of its marginal likelihood."""

    log: float
    solution: Tensor
    variance: float
    factor: Tensor

    @classmethod
    def of(cls, kernel: Tensor, noise: float, root: Tensor, target: Tensor) -> "_Evidence":
        matrix = root[:, None] * kernel * root
        matrix.diagonal().add_(noise + _JITTER * float(matrix.diagonal().mean()))
        factor = torch.linalg.cholesky(matrix)
        white = torch.linalg.solve_triangular(factor, target[:, None], upper=False)
        variance = float(white.square().mean()) + math.ulp(0.0)
        log = -0.5 * len(target) * math.log(variance) - float(factor.diagonal().log().sum())
        solution = torch.linalg.solve_triangular(factor.mT, white, upper=True)[:, 0]
        return cls(log, solution, variance, factor)

    def whiten(self, columns: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(self.factor, columns, upper=False)


def _ridge(s: Tensor, outputs: Tensor, weights: Tensor) -> float:
    """Return the ridge under which outputs [P, m] at s [P, r] are most likely, all with one variance."""
    P, m = outputs.shape
    root = weights.sqrt()[:, None]
    mean = (weights @ outputs) / weights.sum()
    values, vectors = torch.linalg.eigh(root * (s @ s.mT + _CONSTANT) * root.mT)
    power = (vectors.mT @ (root * (outputs - mean))).square().sum(1)

    def log_evidence(ridge: float) -> float:
        spectrum = values.clamp_min(0.0) + ridge
        variance = float((power / spectrum).mean()) / m + math.ulp(0.0)
        return -P * math.log(variance) - float(spectrum.log().sum())

    return max(_RIDGES, key=log_evidence)


def _reduced(u: Tensor) -> tuple[Tensor | None, Tensor]:
    """Return a basis of the span of u [P, n] and the coordinates in it; None, for the identity, and u if P >= n."""
    if len(u) >= u.shape[1]:
        return None, u
    basis, triangle = torch.linalg.qr(u.mT)
    return basis, triangle.mT
