"""Where evaluations show that a function is constant around a point."""

import math

import torch
from torch import Tensor

_PART = 0.25
"""Part of the evaluations around a point that have exactly its value, from which it lies on a plateau."""


def is_plateau(steps: Tensor, values: Tensor, value: float, *, beyond: float) -> bool:
    """Whether a part of the evaluations around a point has exactly its value, out to some distance.

    On the floor of a valley few have it. Where a parameter has no effect, the floor is straight and many have it. Such
    a floor is no plateau: the equal values lie in fewer dimensions than n, and next to the point some value is higher.

    Args:
        steps: to the evaluations from the point [P, n].
        values: [P].
        value: at the point.
        beyond: distance up to which equal values may be due to rounding, root mean square over the parameters.
    """
    distance, order = steps.square().mean(1).sqrt().sort()
    values, around = values[order], distance > beyond
    equal = around & (values == value)
    ends = equal & (equal.cumsum(0) >= _PART * around.cumsum(0))
    if not bool(ends.any()):
        return False
    level = equal & (distance <= distance[ends][-1])
    rises = ~around & (values > value) & torch.isfinite(values)
    return not bool(rises.any()) or _spans(steps[order[level]], beyond * math.sqrt(steps.shape[1]))


def _spans(steps: Tensor, least: float) -> bool:
    """Whether steps [P, n] extend along every direction, by at least this length."""
    return len(steps) >= steps.shape[1] and float(torch.linalg.svdvals(steps)[-1]) > least
