"""Shortest vectors of convex hulls."""

import torch
from torch import Tensor

_STEPS = 100
"""Corners of the hull that are added one after the other, at most."""
_PRECISE, _ROUNDING = 1e-4, 1e-26
"""Relative precision of the squared length; and its size, relative to the longest vector, below which it is zero."""


def shortest(vectors: Tensor) -> Tensor:
    """Return the shortest vector [n] in the convex hull of vectors [m, n]."""
    return shortest_between(torch.zeros_like(vectors[:1]), vectors)


def shortest_between(origins: Tensor, ends: Tensor) -> Tensor:
    """Return the shortest vector [n] from the hull of points [P, n] to the hull of others [Q, n]; 0 if they meet.

    Source: Wolfe (1976), "Finding the nearest point in a polytope"; the vectors between the two sets are not formed.
    """
    size = float((ends - origins[0]).abs().max())
    if size == 0.0:
        return torch.zeros_like(ends[0])
    ends, origins = (ends - origins[0]) / size, (origins - origins[0]) / size  # squares of other sizes are no numbers
    corners, weights = ends[:1], ends.new_ones(1)
    for _ in range(_STEPS):
        x = weights @ corners
        square = float(x @ x)
        corner = ends[int((ends @ x).argmin())] - origins[int((origins @ x).argmax())]
        if square <= _ROUNDING:
            return torch.zeros_like(x)
        if float(corner @ x) >= (1.0 - _PRECISE) * square or bool((corners == corner).all(1).any()):
            break
        corners, weights = _nearest(torch.cat([corners, corner[None]]), torch.cat([weights, weights.new_zeros(1)]))
    return size * (weights @ corners)


def _nearest(corners: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return those of corners [m, n] whose hull has the point nearest to zero in its inside, and weights of the point.

    The point moves from the one with weights [m] towards the nearest point of the affine hull. A corner whose weight
    becomes zero on the way is left out.
    """
    while True:
        others = torch.linalg.lstsq((corners[1:] - corners[0]).mT, -corners[0][:, None], driver="gelsd").solution[:, 0]
        wanted = torch.cat([1.0 - others.sum(0, keepdim=True), others])
        used = wanted <= 0.0
        if not bool(used.any()):
            return corners, wanted
        way = weights[used] / (weights[used] - wanted[used])
        weights = weights + way.min().nan_to_num(nan=0.0) * (wanted - weights)
        left = torch.ones_like(used)
        left[used.nonzero()[int(way.argmin()), 0]] = False
        corners, weights = corners[left], weights[left]
