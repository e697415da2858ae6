"""Whether a black box jumps or fails next to a point: a search ends at a jump as it does at a minimum."""

import torch
from torch import Tensor

_NEXT = ((1e-5, 1e-3), (2e-2, 0.2))
"""Distances in units of sigma, and differences to the value at x over the range of all values: more is a jump."""


def jumps(points: Tensor, losses: Tensor, x: Tensor, value: float, unit: Tensor) -> bool:
    """Whether an evaluation next to x has no finite value, or a value that is much larger than the value at x.

    Kinks and narrow valleys are no jumps: there the difference vanishes with the distance.

    Args:
        points: evaluations [P, n].
        losses: [P].
        x: [n].
        value: the loss at x.
        unit: sigma of every parameter [n].
    """
    finite = losses[torch.isfinite(losses)]
    if not len(finite):
        return False
    distance, range_ = ((points - x) / unit).norm(dim=1), finite.max() - finite.min()
    return not all(bool((losses[distance <= near] - value <= part * range_).all()) for near, part in _NEXT)
