"""The border of a region in which the black box fails: a plane between evaluations with and without a value."""

import torch
from torch import Tensor

from torch_zerohess.linalg.hull import shortest_between

_FARTHEST, _NEARER, _NEAREST = 3.0, 0.6, 0.05
"""Distance up to which evaluations are looked at, its factor where no plane separates them, and the least distance."""
_LEAST = 2
"""Evaluations with a value: one alone may be all that there is."""


def border_between(u: Tensor, holes: Tensor) -> tuple[Tensor, float, bool] | None:
    """Return a unit normal a [n] and b with a.u <= b in the middle between evaluations and holes near the origin.

    Args:
        u: evaluations [P, n], in units of the region, the best one at the origin.
        holes: which of them have no value [P].

    Returns:
        a, b, and whether the plane separates all evaluations that are looked at. Where the border is curved, it
        separates the nearest ones alone. None if there is no hole, no plane, or only one evaluation with a value.
    """
    distance, farthest = u.norm(dim=1), _FARTHEST
    if int((~holes).sum()) < _LEAST:
        return None
    while farthest > _NEAREST and bool((holes & (distance <= farthest)).any()):
        near = distance <= farthest
        inside, outside = u[near & ~holes], u[near & holes]
        normal = torch.nn.functional.normalize(shortest_between(inside, outside), dim=0)
        low, high = float((inside @ normal).max()), float((outside @ normal).min())
        if high > low:
            return normal, 0.5 * (low + high), farthest == _FARTHEST
        farthest *= _NEARER
    return None
