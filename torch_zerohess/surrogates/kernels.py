"""Covariances of outputs at two points, in units of their variance and without its constant part.

A joint kernel is a function of the distance of two points. An additive kernel is the mean over parameters of a function
of the distance along one parameter, or the mean over pairs of parameters of the product of two such functions. With it
an output is a sum of functions of one parameter each, or of two each. Then an evaluation informs about a parameter
whatever the others are: ten parameters are ten lines, or 45 squares, not a box of ten dimensions. An image of several
objects that move by themselves is nearly such a sum.

Source: Duvenaud, Nickisch and Rasmussen (2011), "Additive Gaussian Processes", orders 1 and 2.
"""

import math
from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor

ZERO = 1e-16
"""Added to squared distances: their root has no derivative at zero, and next to it the kernels' derivatives are lost in
rounding."""

Kernel = Callable[[Tensor], Tensor]
"""From distances to covariances."""
Structure = Literal["joint", "single", "pairs"]
"""What a covariance is made of: all parameters at once, single parameters, or pairs of them."""


def matern(distance: Tensor) -> Tensor:
    """Matern kernel of order 3/2: (1 + sqrt(3) d) exp(-sqrt(3) d), once differentiable."""
    scaled = math.sqrt(3.0) * distance
    return (1.0 + scaled) * torch.exp(-scaled)


def gaussian(distance: Tensor) -> Tensor:
    """Gaussian kernel exp(-d^2 / 2), smooth."""
    return torch.exp(-0.5 * distance.square())


KERNELS: tuple[Kernel, ...] = (matern, gaussian)


def with_slopes(kernel: Kernel, distance: Tensor) -> tuple[Tensor, Tensor]:
    """Return a kernel k(d), one of `KERNELS`, and k'(d) / d: its gradient over the difference of the two points."""
    if kernel is gaussian:
        covariance = kernel(distance)
        return covariance, -covariance
    scaled = math.sqrt(3.0) * distance
    decay = torch.exp(-scaled)
    return (1.0 + scaled) * decay, -3.0 * decay


def bends(kernel: Kernel, distance: Tensor, slopes: Tensor) -> Tensor:
    """Return the derivative in d of the slopes k'(d) / d of `with_slopes`, over d."""
    return -slopes if kernel is gaussian else -math.sqrt(3.0) * slopes / distance


_ADDITIVE = 4
"""Parameters from which on additive kernels are worth a try. With fewer a joint kernel covers a box as well."""


def structures(n: int) -> tuple[Structure, ...]:
    """Return the structures to choose from for outputs of n parameters."""
    return ("joint",) if n < _ADDITIVE else ("joint", "single", "pairs")


def separations(structure: Structure, a: Tensor, b: Tensor) -> Tensor:
    """Distances of points a [A, n] and b [B, n]: [A, B] for a joint kernel, [n, A, B] for additive ones."""
    if structure == "joint":
        return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")
    return (a.mT[:, :, None] - b.mT[:, None, :]).abs()


def covariances(structure: Structure, kernel: Kernel, separation: Tensor) -> Tensor:
    """Covariances [A, B], 1 at a distance of 0, from `separations` in units of the length."""
    each = kernel(separation)
    if structure == "joint":
        return each
    if structure == "single":
        return each.mean(0)
    n = len(each)
    return (each.sum(0).square() - each.square().sum(0)) / (n * (n - 1))


def distances(a: Tensor, b: Tensor) -> Tensor:
    """Distances [A, B] of points a [A, n] and b [B, n], with derivatives of every order that a kernel may multiply."""
    middle = b.detach().sum(0) / max(len(b), 1)  # without points, too
    a, b = a - middle, b - middle
    squares = a.square().sum(1)[:, None] + b.square().sum(1) - 2.0 * a @ b.mT
    # Rounding can make a square negative. The correction is a constant for autograd.
    rounding = squares.detach().clamp(max=0.0)
    return (squares - rounding + ZERO).sqrt()
