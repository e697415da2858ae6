"""Levenberg-Marquardt steps of several lengths: s = -(H + shift)^-1 g, each with the shift that fits its radius.

Source: Levenberg (1944), Marquardt (1963).
"""

import torch
from torch import Tensor

_SHIFTS = (1e-8, 1e8)
"""Range of the shift, in units of the largest curvature, or without any of |gradient| / radius; eigenvalues in float32
have errors of 1e-7 in these units."""
_BISECTIONS = 50
"""Halvings of the logarithm of that range: a shift is then known to 14 digits."""


def damped_steps(gradient: Tensor, hessian: Tensor, radii: Tensor) -> Tensor:
    """Return steps s [k, n] that minimise gradient.s + s.hessian s/2 within each of the radii [k], all float64.

    Negative curvature counts as none. Eigenvectors are in float32, as a Jacobian in float32 is not more exact.
    """
    bent, steep = float(hessian.abs().max()), float(gradient.norm())
    size = bent or steep / float(radii.max()) or 1.0
    values, basis = torch.linalg.eigh((hessian / size).float())
    curvature, vectors = size * values.double().clamp_min(0.0), basis.double()
    low, high = _SHIFTS
    shifts = low * size, max(high * size, steep / float(radii.min()))  # this one is enough without any curvature
    return levenberg_steps(vectors.mT @ gradient, curvature, radii, shifts, _BISECTIONS) @ vectors.mT


def levenberg_steps(
    slope: Tensor, curvature: Tensor, radii: Tensor, shifts: tuple[float, float], bisections: int
) -> Tensor:
    """Return steps s [k, r] in the basis of the eigenvectors, within each of the radii [k], all float64.

    s = -slope / (curvature + shift). The shift is found by bisection of its logarithm.

    Args:
        slope: gradient in the basis [r].
        curvature: eigenvalues [r], none negative.
        radii: [k]
        shifts: between which the shift lies, both positive.
        bisections: halvings of the logarithm of their ratio.
    """
    low, high = (slope.new_full((len(radii), 1), one) for one in shifts)
    for _ in range(bisections):
        shift = (low * high).sqrt()
        long = (slope / (curvature + shift)).norm(dim=1, keepdim=True) > radii[:, None]
        low, high = torch.where(long, shift, low), torch.where(long, high, shift)
    return -(slope / (curvature + high))
