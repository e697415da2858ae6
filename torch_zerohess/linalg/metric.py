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

    The constraint that is exceeded most becomes an equation, and the rest of s gets a new step, until none is exceeded.
    The set of active constraints may not be optimal.

    Args:
        gradient: [n].
        hessian: [n, n].
        root: B [n, n].
        lower: [n], at most 0.
        upper: [n], at least 0.
        singular: curvature in B s, relative to the largest one, that may as well be zero.
        border: a and b [n + 1]; s has a.s <= b, too, b at least 0.
    """
    rows, most = torch.cat([root, -root]), torch.cat([upper, -lower])
    if border is not None:
        rows, most = torch.cat([border[None, :-1] @ root, rows]), torch.cat([border[-1:], most])
    length = rows.norm(dim=1)
    rows, most = (rows / length[:, None])[most.isfinite()], (most / length)[most.isfinite()]
    gradient, hessian = root.mT @ gradient, root.mT @ hessian @ root
    u, equations = ball_step(gradient, hessian, 1.0, singular), torch.zeros_like(most, dtype=torch.bool)
    while bool((beyond := torch.where(equations, -1.0, rows @ u - most)).gt(_BEYOND).any()):
        equations[int(beyond.argmax())] = True
        u = torch.linalg.pinv(rows[equations]) @ most[equations]  # the nearest point to the center of the region
        left = 1.0 - float(u @ u)
        if int(equations.sum()) >= len(u) or left <= 0.0:
            u = u / max(1.0, float(u.norm()))
            break
        free = torch.linalg.svd(rows[equations])[2][int(equations.sum()) :].mT
        u = u + free @ ball_step(free.mT @ (gradient + hessian @ u), free.mT @ hessian @ free, left**0.5, singular)
    return (root @ u).clamp(lower, upper)
