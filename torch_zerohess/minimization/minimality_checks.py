"""Why x may be no minimum: the black box falls without end, or it jumps, fails, is constant or has a cusp at x."""

import math

import torch
from torch import Tensor

from torch_zerohess.surrogates.plateau import is_plateau

_NEXT = ((1e-5, 1e-3), (2e-2, 0.2))
"""Distances in units of sigma, and differences to the value at x over the range of all values: more is a jump."""
_EDGE, _LEAST, _SIDE = 1e-4, 1e-6, 3
"""Points within this distance of x, in units of sigma, show an edge. Beyond it values are higher than at x by more than
this part of the range of all values. At least so many points lie on each side."""
_ALIKE, _TENFOLD = 0.05, 10.0
"""Values beyond an edge are higher by the same amount, but for this part of it. The ratio of their distances is at
least the second number. Values on this side are higher by less than the first part of that amount."""
_FAILED = 0.07
"""Distance, root mean square over the parameters in units of sigma, up to which a failure is next to x: before a wall
of failures a search ends at a region of 0.01 sigma, and its last steps are several times as long."""

_PLATEAU = (1e-3, 0.3)
"""Distances, root mean square over the parameters in units of sigma, between which equal values are a plateau: nearer
ones may differ by less than rounding, and farther ones may be other minima."""

_BESIDE, _APART, _STEEPER = 1e-3, 0.1, 8.0
"""Distances in units of sigma up to which an evaluation is beside x, and from which it is apart; how many times as
steep the loss is beside x at a cusp: a square root is ten times as steep at 1e-3 as at 0.1."""
_TOLD = 1e-3
"""Difference, over the range of all values, from which it shows a cusp: less may be roughness."""

DEEP, _DEEPER = 1e100, 1e12
"""Magnitude of a negative loss, and its ratio to the first loss: lower ones are no minimum of anything measured."""
UNBOUNDED = "the loss seems unbounded below, and x is no minimum: check its sign, or give bounds"


def is_unbounded(losses: Tensor) -> bool:
    """Whether a finite loss [P] is out of all proportion to the first one, and below zero."""
    if not len(losses):
        return False
    least = float(losses.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).min())
    return least < -DEEP and least < -_DEEPER * abs(float(losses[0]))


def is_constant(points: Tensor, losses: Tensor, x: Tensor, value: float, unit: Tensor) -> bool:
    """Whether evaluations near x, but not next to it, have exactly the value at x; arguments as of `jumps`."""
    steps = (points - x) / unit
    nearest, farthest = _PLATEAU
    near = steps.square().mean(1).sqrt() <= farthest
    return is_plateau(steps[near], losses[near], value, beyond=nearest)


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
    if not bool(torch.isfinite(losses[distance <= _FAILED * math.sqrt(len(x))]).all()):
        return True
    if not all(bool((losses[distance <= near] - value <= part * range_).all()) for near, part in _NEXT):
        return True
    beside = (distance > 0.0) & (distance <= _EDGE)
    return _has_edge(distance[beside], losses[beside] - value, float(_LEAST * range_))


def _has_edge(distance: Tensor, rise: Tensor, least: float) -> bool:
    """Whether two smooth pieces meet in a jump: rises [K] beyond it are all the same, rises on this side far smaller.

    Roughness has rises of every size, a kink rises that grow with the distance, and rounded values rises of zero.
    """
    if not len(rise) or (highest := float(rise.max())) <= least:
        return False
    beyond, here = rise > 0.5 * highest, (rise > 0.0) & (rise < _ALIKE * highest)
    far = distance[beyond]
    alike = float(rise[beyond].min()) > (1.0 - _ALIKE) * highest and float(far.max()) >= _TENFOLD * float(far.min())
    return alike and min(int(beyond.sum()), int(here.sum())) >= _SIDE


def has_cusp(points: Tensor, losses: Tensor, x: Tensor, unit: Tensor) -> bool:
    """Whether the loss rises much more steeply next to x than farther away: other parameters may then have no effect.

    At a kink it rises as steeply, and at the minimum of a smooth function less. Arguments as of `jumps`.
    """
    distance, finite = ((points - x) / unit).norm(dim=1), torch.isfinite(losses)
    same = finite & (distance == 0.0)
    if not bool(same.any()):
        return False
    rise, range_ = losses - losses[same].min(), losses[finite].max() - losses[finite].min()
    informative = finite & (distance > 0.0) & (rise > _TOLD * range_)
    near, far = (informative & (distance <= _BESIDE)), (finite & (distance >= _APART))
    slopes = rise / distance
    return bool(near.any() and far.any()) and bool(slopes[near].max() > _STEEPER * slopes[far].max())


def doubt(points: Tensor, losses: Tensor, x: Tensor, value: float, unit: Tensor) -> str:
    """Return why x may be no minimum, in words; empty if there is no doubt. Arguments as of `jumps`.

    Distances are in units of the extent of the points where it is smaller than sigma, as in a narrow box.
    """
    if not len(points):
        return ""
    extent = points.amax(0) - points.amin(0)
    unit = torch.where(extent > 0, torch.minimum(unit, extent), unit)
    beside = ((points - x) / unit).norm(dim=1) <= _NEXT[-1][0]
    if is_unbounded(losses) or bool((losses[beside] == -torch.inf).any()):
        return UNBOUNDED
    if jumps(points, losses, x, value, unit):
        return "fn jumps or fails next to x, which may be no minimum"
    if has_cusp(points, losses, x, unit):
        return "fn has a cusp at x, which may be no minimum"
    if is_constant(points, losses, x, value, unit):
        return "fn is constant next to x, which may be no minimum: enlarge sigma"
    return ""
