"""Conjugate gradients inside a trust region (Steihaug 1983; Nocedal and Wright, algorithm 7.2)."""

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor


class Step(NamedTuple):
    """A step s [N], the decrease -(g.s + s.Hs/2) that the model promises, and why the iteration ended."""

    s: Tensor
    decrease: float
    exit: str
    """ "converged", "boundary", "negative curvature" or "iterations"."""


def steihaug(
    product: Callable[[Tensor], Tensor],
    gradient: Tensor,
    radius: float,
    *,
    iterations: int,
    tolerance: float,
) -> Step:
    """Minimise g.s + s.Hs/2 over |s| <= radius, H v = product(v), g = gradient [N].

    Stops when the residual is `tolerance` times the gradient, on the boundary, along the first direction of negative
    curvature (followed to the boundary), or after `iterations` products. The decrease never falls from one iterate to
    the next, so that an early stop is a valid step.
    """
    s, residual = torch.zeros_like(gradient), gradient.clone()
    direction = -residual
    square = residual.dot(residual)
    goal = tolerance * square.sqrt()
    curvature_s = torch.zeros_like(gradient)  # H s, kept for the decrease

    def finish(step: Tensor, image: Tensor, reason: str) -> Step:
        return Step(step, -float(gradient.dot(step) + 0.5 * step.dot(image)), reason)

    if float(square) == 0.0:
        return Step(s, 0.0, "converged")
    for _ in range(iterations):
        image = product(direction)
        bend = direction.dot(image)
        # Rounding in a float32 product is not a direction of negative curvature.
        if float(bend) <= float(direction.dot(direction)) * torch.finfo(direction.dtype).tiny:
            length = _to_boundary(s, direction, radius)
            return finish(s + length * direction, curvature_s + length * image, "negative curvature")
        length = square / bend
        if float((s + length * direction).norm()) >= radius:
            length = _to_boundary(s, direction, radius)
            return finish(s + length * direction, curvature_s + length * image, "boundary")
        s, curvature_s = s + length * direction, curvature_s + length * image
        residual = residual + length * image
        previous, square = square, residual.dot(residual)
        if float(square.sqrt()) <= float(goal):
            return finish(s, curvature_s, "converged")
        direction = -residual + (square / previous) * direction
    return finish(s, curvature_s, "iterations")


def _to_boundary(s: Tensor, direction: Tensor, radius: float) -> Tensor:
    """Return the positive root t of |s + t direction| = radius, in the form that does not cancel."""
    a, b, c = direction.dot(direction), s.dot(direction), s.dot(s) - radius**2
    root = (b * b - a * c).clamp_min(0.0).sqrt()
    return -c / (b + root) if float(b) >= 0.0 else (root - b) / a
