"""The minimum of the larger of two quadratics in a region.

For a share w, let s(w) be the minimum in the region of (1 - w) q_1 + w q_2. The difference q_2 - q_1 at s(w) falls
with w. If both quadratics are convex, the larger one is least at the s(w) where the difference is 0. Where there is no
such w, it is least at s(0) or s(1).
"""

from collections.abc import Callable

import torch
from torch import Tensor

_STEPS = 40
"""Values of w that are tried, at most."""
_EQUAL = 1e-9
"""Difference of the quadratics, over the larger one, that is 0."""
_BETWEEN = 11
"""Points between s(w) on both sides of a jump."""


def least_of_larger(matrices: Tensor, minimum: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Return the minimum s [n] of the larger of two quadratics.

    Args:
        matrices: M [2, n + 1, n + 1], symmetric. The quadratics are (1, s) M (1, s) / 2. The second one should be the
            steeper one: its share is then small, and more exact than a share near 1.
        minimum: returns the minimum [n] in the region of the quadratic with a gradient [n] and a Hessian [n, n].
    """

    def at(share: float) -> tuple[float, Tensor, float, float]:
        mixed = (1.0 - share) * matrices[0] + share * matrices[1]
        s = minimum(mixed[1:, 0], mixed[1:, 1:])
        first, second = two_values(matrices, s[None])[:, 0].tolist()
        return share, s, second - first, max(abs(first), abs(second))

    low, high = at(0.0), at(1.0)
    for share, s, difference, _ in (low, high):
        if (difference <= 0.0) if share == 0.0 else (difference >= 0.0):
            return s
    below, above, moved = low[2], high[2], 0.0
    for _ in range(_STEPS):
        new = at(low[0] + (high[0] - low[0]) * below / (below - above))
        share, s, difference, size = new
        if abs(difference) <= _EQUAL * size:
            return s
        if not low[0] < share < high[0]:
            break
        if difference > 0.0:
            above *= 0.5 if moved > 0.0 else 1.0  # the Illinois rule: an end that stays twice counts half
            low, below = new, difference
        else:
            below *= 0.5 if moved < 0.0 else 1.0
            high, above = new, difference
        moved = difference
    ways = torch.linspace(0.0, 1.0, _BETWEEN, dtype=matrices.dtype, device=matrices.device)[:, None]
    ends = (1.0 - ways) * low[1] + ways * high[1]
    return ends[int(two_values(matrices, ends).amax(0).argmin())]


def two_values(matrices: Tensor, s: Tensor) -> Tensor:
    """Return the values [2, K] of two quadratics, see `least_of_larger`, at s [K, n]."""
    one = torch.cat([torch.ones_like(s[:, :1]), s], 1)
    return 0.5 * ((one @ matrices) * one).sum(2)


def share_of_shortest(first: Tensor, second: Tensor) -> float:
    """Return the share w from 0 to 1 at which (1 - w) g_1 + w g_2 is shortest; g_1 and g_2 are gradients [n]."""
    jump = second - first
    size = float(jump.abs().max())
    if size == 0.0:
        return 0.0
    unit = jump / size  # its square is no 0
    return min(max(-float(first @ unit) / float(unit @ unit) / size, 0.0), 1.0)
