"""Steps of several lengths from one Krylov space: what conjugate gradients would find for each (Gould et al. 1999)."""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.linalg.subproblem import diagonal_steps

_INVARIANT = 1e-10
"""Length of a new direction, relative to the largest curvature, from which on the space is complete."""
_SINGULAR = 1e-12
"""Curvature, relative to the largest one, that may as well be zero: eigenvalues of the products have such errors."""


def krylov_steps(product: Callable[[Tensor], Tensor], gradient: Tensor, radii: Tensor, *, iterations: int) -> Tensor:
    """Return steps s [k, n] that minimise gradient.s + s.Hs/2 within each of the radii [k], H v = product(v).

    s = -(H + shift)^-1 gradient (Levenberg-Marquardt) in the space of gradient, H gradient, H^2 gradient, ...: each is
    the iterate of conjugate gradients on H + shift after `iterations` products, at the most, which all steps share.
    Negative curvature counts as none. float64; zeros if the gradient is zero.

    The basis is built by Lanczos with full reorthogonalization: iterations * n numbers.
    """
    length = float(gradient.norm())
    if length == 0.0:
        return gradient.new_zeros(len(radii), len(gradient))
    basis, diagonal, beside, largest = [gradient / length], [], [], 0.0
    while True:
        q = basis[-1]
        image = product(q)
        diagonal.append(float(q @ image))
        known = torch.stack(basis)
        for _ in range(2):  # twice is enough (Kahan)
            image = image - known.mT @ (known @ image)
        norm = float(image.norm())
        largest = max(largest, abs(diagonal[-1]), norm)
        if len(basis) >= min(iterations, len(gradient)) or norm <= _INVARIANT * largest:
            break
        beside.append(norm)
        basis.append(image / norm)
    off = gradient.new_tensor(beside)
    values, vectors = torch.linalg.eigh(
        torch.diag(gradient.new_tensor(diagonal)) + torch.diag(off, 1) + torch.diag(off, -1)
    )
    curvature, slope = values.clamp_min(0.0), length * vectors[0]
    return diagonal_steps(slope, curvature, radii, _SINGULAR) @ vectors.mT @ known


def are_free(s: Tensor, slope: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return 0 for parameters [n] that a bound holds at s [n] against the slope, and 1 for the others."""
    return (~(((s <= lower) & (slope > 0)) | ((s >= upper) & (slope < 0)))).to(slope)
