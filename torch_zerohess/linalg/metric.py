"""A metric for a trust region, learned from Hessians, and the step of a quadratic inside it and a box."""

import torch
from torch import Tensor

from torch_zerohess.linalg.subproblem import SINGULAR, ball_step

_LEAST = 1e-9
"""Least curvature, relative to the largest one, that a metric takes seriously."""
_WIDEST = 16.0
"""Bound on logarithms of squared lengths of a metric: axes differ by a factor of e^16 at most."""
_SMALLEST = 1e-300
"""Least number of which a logarithm is taken."""
_BEYOND = 1e-12
"""Distance beyond a border or a bound that is rounding, in units of the region."""


def learned(root: Tensor, hessian: Tensor, rate: float, floor: float = 0.0) -> Tensor:
    """Return the root B [n, n] of a metric after a Hessian: log(B B^T) moves by `rate` towards -log|H|, det B = 1.

    In the metric |u| with x = B u the quadratic of |H| is a multiple of |u|^2. B is symmetric and positive.
    """
    curvature, vectors = torch.linalg.eigh(hessian)
    size = curvature.abs()
    size = size.clamp_min(max(_LEAST * float(size.max()), floor) + _SMALLEST)
    wanted = -size.log()
    wanted = (vectors * (wanted - wanted.mean())) @ vectors.mT
    spread, axes = torch.linalg.eigh(root)
    now = (axes * (2.0 * spread.clamp_min(_SMALLEST).log())) @ axes.mT
    spread, axes = torch.linalg.eigh((1.0 - rate) * now + rate * wanted)
    spread = (spread - spread.mean()).clamp(-_WIDEST, _WIDEST)
    return (axes * (0.5 * spread).exp()) @ axes.mT


def region_step(
    gradient: Tensor,
    hessian: Tensor,
    root: Tensor,
    lower: Tensor,
    upper: Tensor,
    singular: float = SINGULAR,
    borders: Tensor | None = None,
) -> Tensor:
    """Return s [n] that minimises gradient.s + s.hessian s/2 within |B^-1 s| <= 1 and lower <= s <= upper.

    s moves from 0 to the minimum under the constraints that hold as equations. On its way the first further constraint
    becomes an equation. At the minimum the equation with the most negative multiplier is given up, as long as this
    lowers the quadratic. If the Hessian is not positive, the set of equations may not be optimal.

    Args:
        gradient: [n].
        hessian: [n, n].
        root: B [n, n].
        lower: [n], at most 0.
        upper: [n], at least 0.
        singular: curvature in B s, relative to the largest one, that may as well be zero.
        borders: rows of a and b [m, n + 1]; s has a.s <= b for each, too, b at least 0.
    """
    rows, most = torch.cat([root, -root]), torch.cat([upper, -lower])
    if borders is not None:
        rows, most = torch.cat([borders[:, :-1] @ root, rows]), torch.cat([borders[:, -1], most])
    length = rows.norm(dim=1)
    rows, most = (rows / length[:, None])[most.isfinite()], (most / length)[most.isfinite()]
    gradient, hessian = root.mT @ gradient, root.mT @ hessian @ root
    u, held = torch.zeros_like(gradient), torch.zeros_like(most, dtype=torch.bool)
    lowest, least = u, torch.inf
    while True:
        end = _least_where(rows[held], most[held], gradient, hessian, singular)
        ahead = torch.where(held, 0.0, rows @ (end - u))
        part = torch.where(ahead > _BEYOND, (most - rows @ u).clamp_min(0.0) / ahead, torch.inf)
        if bool((part < 1.0).any()):
            u = u + part.min() * (end - u)
            held[int(part.argmin())] = True
            continue
        u, slope = end, gradient + hessian @ end
        value = 0.5 * float((gradient + slope) @ u)
        if value >= least:  # without convexity, equations may come and go
            break
        lowest, least = u, value
        if not bool(held.any()):
            break
        forces = rows[held] if float(u.norm()) < 1.0 - _BEYOND else torch.cat([rows[held], u[None]])
        multipliers = -(torch.linalg.pinv(forces.mT) @ slope)[: int(held.sum())]
        if float(multipliers.min()) >= 0.0:
            break
        held[held.nonzero()[int(multipliers.argmin()), 0]] = False
    return (root @ lowest).clamp(lower, upper)


def _least_where(rows: Tensor, most: Tensor, gradient: Tensor, hessian: Tensor, singular: float) -> Tensor:
    """Return u [n] that minimises gradient.u + u.hessian u/2 within |u| <= 1 where rows @ u = most.

    If there is none, the nearest point to 0 with these equations.
    """
    if not len(rows):
        return 0.0 + ball_step(0.0 + gradient, 0.0 + hessian, 1.0, singular)  # -0.0 is 0.0, as in the sums below
    across, sizes, along = torch.linalg.svd(rows)
    count, sizes = len(sizes), sizes.clamp_min(_BEYOND)  # rows may depend on each other
    end = along[:count].mT @ (across[:, :count].mT @ most / sizes)
    free, left = along[count:].mT, 1.0 - float(end @ end)
    if free.shape[1] and left > 0.0:
        slope, bend = free.mT @ (gradient + hessian @ end), free.mT @ hessian @ free
        end = end + free @ ball_step(slope, bend, left**0.5, singular)
    return end
