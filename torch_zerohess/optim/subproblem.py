"""Minimum of a quadratic in a ball and a box: the step of a trust region."""

import math

import torch
from torch import Tensor

_BISECTIONS = 60


def ball_step(gradient: Tensor, hessian: Tensor, radius: float) -> Tensor:
    """Return s [r] with |s| <= radius that minimises gradient.s + s.hessian s/2, hessian [r, r] of any signature.

    By the eigenvectors of the Hessian and bisection for the shift mu of s = -(H + mu I)^-1 g (More and Sorensen 1983).
    In the hard case, where the gradient has no component along the most negative curvature, the step is completed
    along it to the boundary.
    """
    curvature, vectors = torch.linalg.eigh(hessian)
    a, lowest = vectors.mT @ gradient, float(curvature[0])
    length, largest = float(gradient.norm()), float(curvature.abs().max())
    if length == 0.0 and lowest >= 0.0:
        return torch.zeros_like(gradient)
    if lowest > 1e-14 * largest:
        s = -a / curvature
        if float(s.norm()) <= radius:
            return vectors @ s
    low = max(0.0, -lowest) + 1e-12 * max(largest, math.ulp(0.0) * 1e12)
    high = low + length / radius + largest
    s = -a / (curvature + low)
    if float(s.norm()) <= radius and lowest < 0.0:  # the hard case
        s[0] += math.copysign(math.sqrt(max(radius**2 - float(s.square().sum()), 0.0)), float(s[0]) or 1.0)
        return vectors @ (s * (radius / float(s.norm())))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        if float((a / (curvature + middle)).norm()) > radius:
            low = middle
        else:
            high = middle
        if high - low <= 1e-9 * high:
            break
    return vectors @ (-a / (curvature + high))


def box_step(gradient: Tensor, hessian: Tensor, radius: float, lower: Tensor, upper: Tensor) -> Tensor:
    """Return a step as `ball_step`, with lower <= s <= upper [r]: parameters that hit a bound stay there."""
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
    return s
