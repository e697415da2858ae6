"""Minimum of a quadratic in a ball and a box: the step of a trust region. Steps of several lengths."""

import math

import torch
from torch import Tensor

_NEWTON_STEPS = 60
"""Steps to the shift of the Hessian, at most."""
_PRECISE = 1e-13
"""A step is longer than the radius by this share at most."""
SINGULAR = 1e-14
"""Curvature, relative to the largest one, that may as well be zero."""
_LEAST = 100.0
"""Least shift, over this curvature."""
_SMALLEST = 1e-300
"""Least number that is divided by."""
_LONGEST, _HALVINGS = 8, 24
"""Lengths tried along the gradient where bounds are hit: radius times 2^8 and less."""
_ROUNDED = 1e-10
"""`SINGULAR` where eigenvalues are in float32. Their errors are near 1e-7 of the largest eigenvalue."""


def ball_step(gradient: Tensor, hessian: Tensor, radius: float, singular: float = SINGULAR) -> Tensor:
    """Return s [r] with |s| <= radius that minimises gradient.s + s.hessian s/2, hessian [r, r] of any signature.

    singular: curvature, relative to the largest one, that may as well be zero.
    """
    curvature, vectors = torch.linalg.eigh(hessian)
    return vectors @ diagonal_step(vectors.mT @ gradient, curvature, radius, singular)


def damped_steps(gradient: Tensor, hessian: Tensor, radii: Tensor) -> Tensor:
    """Return steps s [k, n] that minimise gradient.s + s.hessian s/2 within each of the radii [k], all float64.

    Negative curvature counts as none. Eigenvectors are in float32, as a Jacobian in float32 is not more exact.
    """
    size = float(hessian.abs().max()) or 1.0
    values, basis = torch.linalg.eigh((hessian / size).float())
    curvature, vectors = size * values.double().clamp_min(0.0), basis.double()
    return diagonal_steps(vectors.mT @ gradient, curvature, radii, _ROUNDED) @ vectors.mT


def diagonal_steps(a: Tensor, curvature: Tensor, radii: Tensor, singular: float) -> Tensor:
    """Return steps [k, r] of `diagonal_step` for each of the radii [k]."""
    return torch.stack([diagonal_step(a, curvature, radius, singular) for radius in radii.tolist()])


def diagonal_step(a: Tensor, curvature: Tensor, radius: float, singular: float = SINGULAR) -> Tensor:
    """Return s [r] with |s| <= radius that minimises a.s + s.(curvature s)/2, in any order and of any sign.

    By Newton's method for the shift mu of s = -a / (curvature + mu) (More and Sorensen 1983). In the hard case a has no
    component along the most negative curvature; the step then goes on along it, to the boundary.
    """
    least, index = curvature.min(0)
    lowest, largest = float(least), float(curvature.abs().max())
    if lowest > singular * largest:
        s = -a / curvature
        if float(s.norm()) <= radius:
            return s
    scale = max(float(a.abs().max()) / radius, largest)
    if scale == 0.0:
        return torch.zeros_like(a)
    # In units of radius and scale, where nothing over- or underflows: s = -a / (gap + rest), mu = rest - lowest.
    a, curvature, largest = a / scale / radius, curvature / scale, largest / scale
    negative = lowest < -singular * largest * scale
    gap = curvature - curvature[index] if negative else curvature.clamp_min(0.0)
    low = _SMALLEST if negative else max(_LEAST * singular * largest, _SMALLEST)
    s = -a / (gap + low)
    if float(s.norm()) <= 1.0:
        if negative:  # the hard case
            missing = 1.0 - float(s.square().sum()) + float(s[index] ** 2)
            s[index] = math.copysign(math.sqrt(max(missing, 0.0)), float(s[index]))
        return radius * s
    return radius * -a / (gap + _shift(a.tolist(), gap.tolist(), low))


def _shift(a: list[float], gap: list[float], low: float) -> float:
    """Return mu with |a / (gap + mu)| = 1; mu is greater than `low`, gap is at least 0.

    By Newton's method for 1/|a / (gap + mu)| = 1. The left side is concave in mu, so steps from below stay below.
    """
    shift = max(low, *(abs(one) - bend for one, bend in zip(a, gap, strict=True)))
    for _ in range(_NEWTON_STEPS):
        squares = [(one / (bend + shift)) ** 2 for one, bend in zip(a, gap, strict=True)]
        length = math.sqrt(sum(squares))
        if length - 1.0 <= _PRECISE:
            break
        slope = sum(square / (bend + shift) for square, bend in zip(squares, gap, strict=True))
        shift += (length - 1.0) * length * length / slope
    return shift


def box_step(gradient: Tensor, hessian: Tensor, radius: float, lower: Tensor, upper: Tensor) -> Tensor:
    """Return a step as `ball_step` that also stays within lower <= s <= upper [r].

    Parameters that hit a bound stay there, and the others get a new step. The set that hits is a guess. The best point
    along the projected gradient is returned if it is better.
    """
    s, free = torch.zeros_like(gradient), torch.ones_like(gradient, dtype=torch.bool)
    while bool(free.any()):
        left = radius**2 - float(s[~free].square().sum())
        if left <= 0.0:
            s[free] = 0.0
            break
        inner = gradient[free] + hessian[free][:, ~free] @ s[~free]
        s[free] = ball_step(inner, hessian[free][:, free], math.sqrt(left))
        hit = free & ((s < lower) | (s > upper))
        s = s.clamp(lower, upper)
        if not bool(hit.any()):
            break
        free &= ~hit
    if bool(free.all()):
        return s
    s = s * min(1.0, radius / max(float(s.norm()), _SMALLEST))
    path = _projected_gradient(gradient, radius, lower, upper)
    every = torch.cat([s[None], path])
    return every[int((every @ gradient + 0.5 * ((every @ hessian) * every).sum(1)).argmin())]


def _projected_gradient(gradient: Tensor, radius: float, lower: Tensor, upper: Tensor) -> Tensor:
    """Return points down the gradient, [24, r], each moved to the nearest point of the box and into the ball."""
    largest = gradient.abs().max().clamp_min(_SMALLEST)
    lengths = radius * 2.0 ** torch.arange(
        _LONGEST, _LONGEST - _HALVINGS, -1, dtype=gradient.dtype, device=gradient.device
    )
    path = (-lengths[:, None] * (gradient / largest)).clamp(lower, upper)
    return path * (radius / path.norm(dim=1, keepdim=True).clamp_min(radius))
