"""Whether a black box jumps or fails next to a point: a search ends at a jump as it does at a minimum."""

import torch
from torch import Tensor

_NEXT = 1e-5
"""Distance, in units of sigma, within which evaluations are next to a point."""
_JUMP = 1e-3
"""Difference to the value at the point that is a jump, relative to the range of all values."""


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
    near = losses[((points - x) / unit).square().sum(1) <= _NEXT**2]
    finite = losses[torch.isfinite(losses)]
    if not len(near) or not len(finite):
        return False
    return not bool((near - value <= _JUMP * (finite.max() - finite.min())).all())
