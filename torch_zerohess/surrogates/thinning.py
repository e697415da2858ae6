"""Which evaluations a full memory keeps: of points that are close to each other, the later ones."""

import torch
from torch import Tensor

_BLOCK = 64
"""Points whose distances to others are held at once: they fit into the cache of a processor."""


def farthest_from_later(points: Tensor, count: int) -> Tensor:
    """Return the numbers [count], in order, of the points [P, n] whose nearest neighbour among later ones is farthest.

    Distances are in units of the standard deviation of every parameter.
    """
    points = points.double()  # the squares of distances are differences
    deviation = points.std(0)
    scaled = (points - points.mean(0)) / torch.where(deviation > 0, deviation, 1.0)
    half = 0.5 * scaled.square().sum(1)
    nearest = torch.cat([_to_later(scaled[row:], half[row:]) for row in range(0, len(scaled), _BLOCK)])
    return nearest.argsort()[len(points) - count :].sort().values


def _to_later(points: Tensor, half: Tensor) -> Tensor:
    """Return half the squared distances of the first points of [P, n] to the nearest of those after them.

    They are infinite for the last point. `half` is half the squares of the points [P]: |a - b|^2 = |a|^2 + |b|^2 - 2 ab
    takes one product of matrices.
    """
    block = points[:_BLOCK]
    apart = torch.addmm(half, block, points.mT, alpha=-1.0)
    itself_or_earlier = torch.ones_like(apart[:, :_BLOCK], dtype=torch.bool).tril()
    apart[:, :_BLOCK].masked_fill_(itself_or_earlier, float("inf"))
    return apart.amin(1) + half[:_BLOCK]
