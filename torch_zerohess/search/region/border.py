"""Borders of a region in which the black box fails: planes between evaluations with and without a value."""

import torch
from torch import Tensor

from torch_zerohess.linalg.hull import shortest_between

_FARTHEST, _NEARER, _NEAREST = 3.0, 0.6, 0.05
"""Distance up to which evaluations are looked at, its factor where no planes separate them, and the least distance."""
_LEAST = 2
"""Evaluations with a value: one alone may be all that there is."""
_SINGLE, _SHARE = 0.01, 0.3
"""Distance of a plane's holes from the evaluations with a value, over the distance of the first of these holes, at
least: for a single plane, and for each of several."""


def borders_between(u: Tensor, holes: Tensor) -> tuple[Tensor, bool] | None:
    """Return rows of a unit normal a and b [m, n + 1] with a.u <= b at the evaluations near the origin.

    Every hole near the origin is beyond one of these planes. A single plane lies in the middle between evaluations and
    holes. If no single plane separates them well, a plane begins with the hole nearest to the origin, and takes all
    holes that are about as far beyond it. The other holes get further planes. m planes lie nearer to the evaluations: a
    step may end in the corner of min(m, n) of them. If each border is equally likely anywhere between evaluations and
    holes, the corner has a value with probability 1/2.

    Args:
        u: evaluations [P, n], in units of the region, the best one at the origin.
        holes: which of them have no value [P].

    Returns:
        a and b, and whether the planes separate all evaluations that are looked at. Where some hole lies among
        evaluations, they separate the nearest ones alone. None if there is no hole, no plane, or only one evaluation
        with a value.
    """
    distance, farthest = u.norm(dim=1), _FARTHEST
    if int((~holes).sum()) < _LEAST:
        return None
    order = distance.argsort(stable=True)
    while farthest > _NEAREST and bool((holes & (distance <= farthest)).any()):
        near = order[distance[order] <= farthest]
        planes = _separating(u[near[~holes[near]]], u[near[holes[near]]])
        if planes is not None:
            return planes, farthest == _FARTHEST
        farthest *= _NEARER
    return None


def _separating(inside: Tensor, outside: Tensor) -> Tensor | None:
    """Return planes [m, n + 1] between points [P, n] and each of others [Q, n]; None if one of these is among them."""
    one = _between(inside, outside)
    planes = [one] if one[2] > _SINGLE * _between(inside, outside[:1])[2] else []
    outside = outside[:0] if planes else outside
    while len(outside):
        normal, low, width = _between(inside, outside[:1])
        least, chosen = _SHARE * width, 1
        if width <= 0.0:
            return None
        while True:
            joins = outside @ normal - low >= least
            if int(joins.sum()) <= chosen:
                break
            chosen = int(joins.sum())
            normal, low, width = _between(inside, outside[joins])
        planes.append((normal, low, width))
        outside = outside[outside @ normal - low < min(least, width) * (1.0 - 1e-9)]
    part = 1.0 - 0.5 ** (1.0 / min(len(planes), inside.shape[1]))
    return torch.stack([torch.cat([normal, normal.new_tensor([low + part * width])]) for normal, low, width in planes])


def _between(inside: Tensor, outside: Tensor) -> tuple[Tensor, float, float]:
    """Return the normal [n] of the planes between two sets of points, the first plane, and the distance to the last."""
    normal = torch.nn.functional.normalize(shortest_between(inside, outside), dim=0)
    low = float((inside @ normal).max())
    return normal, low, float((outside @ normal).min()) - low
