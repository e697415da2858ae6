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
    border: Tensor | None = None,
) -> Tensor:
    """Return s [n] that minimises gradient.s + s.hessian s/2 within |B^-1 s| <= 1 and lower <= s <= upper.

    The parameter farthest beyond a bound is set to the bound, and the others get a new step in the rest of the region,
    until none is beyond. The set of parameters at bounds is a guess.

    Args:
        gradient: [n].
        hessian: [n, n].
        root: B [n, n].
        lower: [n], at most 0.
        upper: [n], at least 0.
        singular: curvature in B s, relative to the largest one, that may as well be zero.
        border: a and b [n + 1]; s has a.s <= b, too, b at least 0.
    """
    if border is not None:
        u = _constrained(root.mT @ gradient, root.mT @ hessian @ root, root, lower, upper, border, singular)
        return (root @ u).clamp(lower, upper)
    s = root @ ball_step(root.mT @ gradient, root.mT @ hessian @ root, 1.0, singular)
    beyond = torch.maximum(lower - s, s - upper)
    if float(beyond.max()) <= 0.0:
        return s
    inverse = torch.linalg.inv(root)
    metric = inverse.mT @ inverse
    free = torch.ones_like(s, dtype=torch.bool)
    fixed = torch.zeros_like(s)
    while float(beyond.max()) > 0.0:
        k = int(beyond.argmax())
        fixed[k] = s[k].clamp(lower[k], upper[k])
        free[k] = False
        s = fixed.clone()
        if not bool(free.any()):
            break
        own = torch.linalg.inv(torch.linalg.cholesky(metric[free][:, free])).mT
        middle = -own @ (own.mT @ (metric[free] @ fixed))  # the nearest point of the metric's ball, given the fixed
        s[free] = middle
        left = 1.0 - float(s @ metric @ s)
        if left > 0.0:
            inner = gradient[free] + hessian[free] @ s
            bend = own.mT @ hessian[free][:, free] @ own
            s[free] = middle + own @ ball_step(own.mT @ inner, bend, left**0.5, singular)
        beyond = torch.where(free, torch.maximum(lower - s, s - upper), 0.0)
    return s.clamp(lower, upper)


def _constrained(
    gradient: Tensor, hessian: Tensor, root: Tensor, lower: Tensor, upper: Tensor, border: Tensor, singular: float
) -> Tensor:
    """Return u [n] that minimises gradient.u + u.hessian u/2 within |u| <= 1, a border, and bounds on s = root u.

    The constraint that is farthest exceeded becomes an equation, until none is exceeded.
    """
    rows = torch.cat([border[None, :-1] @ root, root, -root])
    most = torch.cat([border[-1:], upper, -lower])
    length = rows.norm(dim=1)
    rows, most = (rows / length[:, None])[most.isfinite()], (most / length)[most.isfinite()]
    u, equations = ball_step(gradient, hessian, 1.0, singular), torch.zeros_like(most, dtype=torch.bool)
    while float((beyond := torch.where(equations, -1.0, rows @ u - most)).max()) > _BEYOND:
        equations[int(beyond.argmax())] = True
        u = torch.linalg.pinv(rows[equations]) @ most[equations]  # the nearest point to the center of the region
        left = 1.0 - float(u @ u)
        if int(equations.sum()) >= len(u) or left <= 0.0:
            return u / max(1.0, float(u.norm()))
        free = torch.linalg.svd(rows[equations])[2][int(equations.sum()) :].mT
        u = u + free @ ball_step(free.mT @ (gradient + hessian @ u), free.mT @ hessian @ free, left**0.5, singular)
    return u
