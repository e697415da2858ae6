"""Quadratic of a loss by least change: interpolate the values near a point, and change the Hessian no more than needed.

A full quadratic in n parameters has (n + 1)(n + 2)/2 coefficients, more than a search has evaluations. Many quadratics
interpolate the values. We take the quadratic with the Hessian nearest to an earlier Hessian in the Frobenius norm. It
is unique once the points span the space (Powell 2004, "Least Frobenius norm updating of quadratic models").
"""

import torch
from torch import Tensor

_EXACT = 1e-10
"""Variance of a value that is no quadratic, in units of the mean variance of the quadratics at the points."""
_CUBIC = 1e-8
"""The same per sixth power of the distance: a smooth function leaves a quadratic by third powers."""
_FREE = 1e-12
"""Prior precision of value and slope, in units of the values' own precision."""


def least_change(u: Tensor, values: Tensor, hessian: Tensor) -> tuple[float, Tensor, Tensor]:
    """Return value, gradient [n] and Hessian [n, n] at u = 0 of the quadratic of least change.

    Args:
        u: points [P, n], of the order of 1.
        values: [P], of the order of 1.
        hessian: the earlier one [n, n].

    With fewer than n + 1 points the gradient has the least norm. With more points than a quadratic has coefficients the
    result is a regression, in which near points count more than far ones.
    """
    P, n = u.shape
    inner = u @ u.mT
    kernel = 0.5 * inner.square()
    size = inner.diagonal()
    unit = float(kernel.diagonal().mean()) or 1.0
    kernel.diagonal().add_(_EXACT * unit + _CUBIC * size.pow(3))
    rest = values - 0.5 * ((u @ hessian) * u).sum(1)
    factor = torch.linalg.cholesky(kernel)
    linear = torch.cat([u.new_ones(P, 1), u, rest[:, None]], 1)
    white = torch.linalg.solve_triangular(factor, linear, upper=False)
    design, target = white[:, :-1], white[:, -1]
    scale = float(design.square().sum(0).amax())
    padded = torch.cat([design, (_FREE * scale) ** 0.5 * torch.eye(n + 1, dtype=u.dtype, device=u.device)])
    q, r = torch.linalg.qr(padded)
    slope = torch.linalg.solve_triangular(r, (q.mT @ torch.cat([target, target.new_zeros(n + 1)]))[:, None], upper=True)
    left = (target - design @ slope[:, 0])[:, None]
    alpha = torch.linalg.solve_triangular(factor.mT, left, upper=True)[:, 0]
    change = (u.mT * alpha) @ u
    return float(slope[0, 0]), slope[1:, 0], hessian + 0.5 * (change + change.mT)
