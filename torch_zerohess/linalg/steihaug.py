"""Conjugate gradients inside a trust region (Steihaug 1983; Nocedal and Wright, algorithm 7.2), aware of noise."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.linalg.magnitudes import power_of_two
from torch_zerohess.linalg.step import Step


def steihaug(
    product: Callable[[Tensor], Tensor],
    gradient: Tensor,
    radius: float,
    *,
    iterations: int,
    tolerance: float,
    noise: float = 0.0,
) -> Step:
    """Minimise g.s + s.Hs/2 over |s| <= radius, H v = product(v) [N], g = gradient [N].

    Stops when the residual is `tolerance` times the gradient ("converged"), on the boundary ("boundary"), along the
    first direction of negative curvature, followed to the boundary ("negative curvature"), or after `iterations`
    products ("iterations"). The decrease never falls from one iterate to the next, so that an early stop is a valid
    step.

    Where g and H are means of R independent estimates, gradient [R, N] and product(v) [R, N] may give all of them.
    Their spread measures the error of the residual g + H s and of the curvature d.Hd along a direction, and iterations
    stop ("noise") when the residual, or the curvature, is of the size that errors alone would have (see `noise_level`):
    what follows would be fitted to the noise, and grows without limit in flat directions. If the curvature of the very
    first direction is that uncertain, it is taken at the upper end of its error.
    """
    scale = power_of_two(gradient)  # squares of small and of large gradients are no numbers
    residuals = gradient.reshape(-1, gradient.shape[-1]) / scale
    residual = residuals.mean(0)
    g, s = residual, torch.zeros_like(residual)
    direction = -residual
    square = residual.dot(residual)
    goal = tolerance * square.sqrt()
    images_s = torch.zeros_like(residual)  # H s, kept for the decrease

    def finish(step: Tensor, image: Tensor, reason: str) -> Step:
        return Step(step, -scale * float(g.dot(step) + 0.5 * step.dot(image)), reason)

    if float(square) == 0.0:
        return finish(s, images_s, "converged")
    for iteration in range(iterations):
        if float(square.sqrt()) < noise_level(residuals, noise):
            return finish(s, images_s, "noise")
        images = product(direction).reshape(residuals.shape) / scale
        image = images.mean(0)
        bend = direction.dot(image)
        error = noise_level((images @ direction)[:, None], noise)
        uncertain = float(bend.abs()) < error
        if uncertain and iteration:
            return finish(s, images_s, "noise")
        # What is too small to divide by goes to the boundary, too.
        if not uncertain and float(bend) <= float(direction.dot(direction)) * torch.finfo(direction.dtype).tiny:
            length = _to_boundary(s, direction, radius)
            return finish(s + length * direction, images_s + length * image, "negative curvature")
        length = square / (bend.clamp_min(0.0) + error if uncertain else bend)
        if float((s + length * direction).norm()) >= radius:
            length = _to_boundary(s, direction, radius)
            return finish(s + length * direction, images_s + length * image, "boundary")
        s, images_s = s + length * direction, images_s + length * image
        if uncertain:
            return finish(s, images_s, "noise")
        residuals = residuals + length * images
        residual = residuals.mean(0)
        previous, square = square, residual.dot(residual)
        if float(square.sqrt()) <= float(goal):
            return finish(s, images_s, "converged")
        direction = -residual + (square / previous) * direction
    return finish(s, images_s, "iterations")


def noise_level(estimates: Tensor, noise: float) -> float:
    """Return the length below which the mean of independent estimates [R, N] does not differ from zero.

    If there is nothing but errors, the squared length of the mean has the expectation tr C and the variance 2 tr C^2,
    with the covariance C [N, N] of the mean, here from the spread of the R. The level is the root of the expectation
    plus `noise` standard deviations. With `noise` = 2 it is 1.96 standard errors for N = 1, and tends to one standard
    error for large N. It is zero for one estimate, or without `noise`.
    """
    R = len(estimates)
    if R < 2 or noise == 0.0:
        return 0.0
    deviations = estimates - estimates.mean(0)
    gram = deviations @ deviations.mT / (R * (R - 1))  # trace(gram) = tr C, |gram|^2 = tr C^2
    return float((gram.trace() + noise * math.sqrt(2) * gram.norm()).sqrt())


def _to_boundary(s: Tensor, direction: Tensor, radius: float) -> Tensor:
    """Return the positive root t of |s + t direction| = radius, in the form that does not cancel."""
    a, b, c = direction.dot(direction), s.dot(direction), s.dot(s) - radius**2
    root = (b * b - a * c).clamp_min(0.0).sqrt()
    return -c / (b + root) if float(b) >= 0.0 else (root - b) / a
