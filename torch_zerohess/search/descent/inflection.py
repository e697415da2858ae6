"""A check of the end of a round: no inflection is taken for a minimum.

At an inflection, as of x^3, slope and curvature are zero, and the steps of quadratics end there. So where the curvature
along some direction is next to nothing, the loss is evaluated at two points along it, one on each side. If one of them
is lower, the search goes on from there. At a minimum like that of x^4 both are higher.
"""

import torch
from torch import Tensor

from torch_zerohess.search.descent.metric_progress import MetricProgress

_FLAT = 1e-4
"""Share of the largest curvature below which a curvature is next to nothing."""
_APART = 0.03
"""Least distance from the best point, over the first sigma, of evaluations that measure the largest curvature."""
ASIDE = 0.1
"""Distance of the two points from the best point, over the first sigma."""
_GAIN = 1e-6
"""Least decrease of the loss that counts, over what the largest curvature adds at this distance."""


def both_sides(known: MetricProgress, hessian: Tensor) -> Tensor | None:
    """Return two points [2, n] along the least curvature at the best point, if that is next to nothing."""
    curvatures, directions = torch.linalg.eigh(hessian)
    step = ASIDE * directions[:, 0]
    is_flat = abs(float(curvatures[0])) < _FLAT * _largest(known)
    return known.lowest.point + torch.stack([step, -step]) if is_flat else None


def least_gain(known: MetricProgress) -> float:
    """Return the decrease of the loss at such a point from which it is lower."""
    return _GAIN * _largest(known) * ASIDE**2


def _largest(known: MetricProgress) -> float:
    """Return the largest curvature between the best point and an evaluation apart from it; 0 if there is none."""
    squares = (known.points - known.lowest.point).square().sum(1)
    apart = (squares >= _APART**2) & ~known.holes
    curvatures = 2.0 * (known.values[apart] - known.lowest.loss) / squares[apart]
    return float(curvatures.max()) if len(curvatures) else 0.0
