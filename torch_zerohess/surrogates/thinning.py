"""Which evaluations a full memory keeps: of points that are close to each other, the later ones."""

import torch
from torch import Tensor

_BLOCK = 1024
"""Points whose distances to others are held at once."""


def farthest_from_later(points: Tensor, count: int) -> Tensor:
    """Return the numbers [count], in order, of the points [P, n] whose nearest neighbour among later ones is farthest.

    Distances are in units of the standard deviation of every parameter.
    """
    points = points.to(torch.promote_types(points.dtype, torch.float32))  # half precision has no distances
    deviation = points.std(0)
    scaled = (points - points.mean(0)) / torch.where(deviation > 0, deviation, 1.0)
    nearest = torch.cat([_to_later(scaled, row) for row in range(0, len(scaled), _BLOCK)])
    return nearest.argsort()[len(points) - count :].sort().values


def _to_later(points: Tensor, first: int) -> Tensor:
    """Return the distances of a block of points [P, n] to the nearest of those after them; infinite for the last."""
    block = points[first : first + _BLOCK]
    apart = torch.cdist(block, points[first:], compute_mode="donot_use_mm_for_euclid_dist")
    later = torch.ones_like(apart, dtype=torch.bool).triu(1)
    return apart.masked_fill(~later, float("inf")).min(1).values
