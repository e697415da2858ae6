"""A least-squares quadratic around a point, from as many near evaluations as give the least error of its curvature."""

import math

import torch
from torch import Tensor

from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count, factored, quadratic_terms, symmetric

_SPARE = 5
"""Evaluations beyond the coefficients of a quadratic, at least: the residuals give the standard errors."""
_WIDER = 1.3
"""Factor between the numbers of evaluations that are tried."""
_MOST = 3
"""Evaluations that are tried at most, over the coefficients."""
_REACH = 2.0
"""Distance of the farthest evaluation, in units of the width."""


def quadratic_around(x: Tensor, points: Tensor, values: Tensor) -> tuple[LocalModel, float, float] | None:
    """Return the least-squares quadratic around x [n], its width, and the relative standard error of its Hessian.

    Args:
        x: its centre.
        points: evaluations [P, n], float64.
        values: their losses [P]; points whose loss is not finite are left out.

    The number of nearest evaluations is chosen for the least of this error. A quadratic function is found exactly. None
    if the evaluations do not determine a quadratic.
    """
    finite = torch.isfinite(values)
    points, values = points[finite], values[finite]
    n = len(x)
    determined = coefficient_count(n)
    distance, order = (points - x).norm(dim=1).sort()
    best, least = None, math.inf
    count = determined + max(_SPARE, n)
    most = min(len(order), _MOST * determined + _SPARE + n)
    while count <= most:
        sigma = float(distance[count - 1]) / _REACH
        near = order[:count]
        fitted = _least_squares((points[near] - x) / sigma, values[near]) if sigma > 0.0 else None
        if fitted is not None and fitted[1] < least:
            best, least = (fitted[0], sigma, fitted[1]), fitted[1]
        count = math.ceil(_WIDER * count)
    return best


def _least_squares(u: Tensor, values: Tensor) -> tuple[LocalModel, float] | None:
    """Return a quadratic fitted to values [P] at u [P, n], and the relative standard error of its Hessian."""
    P, n = u.shape
    base = values.min()
    size = float((values - base).max())
    if size == 0.0:
        return None
    design = quadratic_terms(u)
    factors = factored(design)
    if factors is None:
        return None
    q, inverse = factors
    target = (values - base) / size
    solution = inverse @ (q.mT @ target)
    spare = P - design.shape[1]
    missed = float((target - design @ solution).norm()) * math.sqrt(P / spare)
    rounding = torch.finfo(values.dtype).eps * float(values.abs().max()) / size
    # What is not quadratic does not average out over the evaluations (Cauchy and Schwarz).
    error = math.hypot(missed, rounding) * inverse.norm(dim=1)
    hessian = symmetric(solution[n + 1 :], n)
    scale = float(hessian.norm())
    row, column = torch.triu_indices(n, n, device=u.device)
    half = torch.where(row == column, 0.5, 1.0).to(u)
    relative = float((error[n + 1 :] / half).norm()) / scale if scale > 0.0 else math.inf
    model = LocalModel(
        float(base) + size * float(solution[0]),
        size * solution[1 : n + 1],
        size * hessian,
        None,
        size * error[1 : n + 1],
        size * error[n + 1 :][row == column],
    )
    return model, relative
