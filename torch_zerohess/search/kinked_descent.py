"""Descent on quadratics that does not take a kink for a minimum.

Near a kink the quadratics of a loss predict nothing, and their region shrinks wherever it is. So where the loss rises
as steeply beside the best point as farther away, slopes are measured at random points around it, and their convex hull
is looked at (gradient sampling: Burke, Lewis and Overton 2005). If the shortest vector of the hull is zero, the best
point is stationary. Otherwise its opposite is a direction of descent, and the search goes on from a lower point there.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from torch_zerohess.linalg.hull import shortest
from torch_zerohess.search.metric_descent import MetricProgress, MetricQuadratics
from torch_zerohess.search.random_points import normal
from torch_zerohess.search.state import Evaluated

_BESIDE, _APART = 1e-4, ((1e-2, 1.0), (1.0, math.inf))
"""Distances over the tolerance up to which an evaluation is beside the best point, and between which it is apart; the
second ones where there are none between the first ones."""
_STEEP, _JUMP = 0.1, 100.0
"""How steeply the loss rises beside a kink, over how steeply it rises apart from it, at least; and beside a jump."""
_ROUNDING = 1e4 * torch.finfo(torch.float64).eps
"""Rise, relative to the loss, up to which it may be rounding."""
_AROUND, _CLOSE = 1e-2, 1e-2
"""Distance over the tolerance of the points whose slopes are measured; that of the differences, over this distance."""
_MOST = 4
"""Slopes that are measured, over n + 1, at most."""
_UNKNOWN = "the slopes around a kink do not tell whether it is a minimum"
_ZERO = 1e-3
"""Length of a vector in the hull that counts as zero, over the mean length of the slopes."""
_LENGTHS = (0.3, 1.0, 3.0)
"""Steps that are tried, over the distance of the points whose slopes are measured."""
_WIDER = 2.0
"""Sigma with which the search goes on, over the length of the step that has found a lower point."""


class KinkedQuadratics(MetricQuadratics):
    """Descent on quadratics that looks at kinks before it ends at them."""

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        if known.slopes is None:
            return super().next(known, evaluated, generator)
        before, sampled, n = known.lowest, known.slopes, self._n
        after = known.remembered(evaluated, self._capacity)
        if after.lowest.loss < before.loss:
            step = float((after.lowest.point - before.point).norm())
            root = torch.eye(n, dtype=known.root.dtype, device=known.root.device)
            after = replace(after, slopes=None, phase="geometry", root=root, sigma=_WIDER * step, rejected=0, tied=0)
            return self.plan(after, generator)
        known = replace(known, evaluations=after.evaluations)
        simplex = evaluated.needed.those(slice(-n - 1, None))
        complete = len(evaluated.needed) == n + 1 + (len(_LENGTHS) if len(sampled) >= n else 0)
        if not bool(evaluated.finite.all()):  # it is a border
            return self._arrived(known, known.reason, generator)
        if not complete:
            return self._ended(replace(known, slopes=None), None, _UNKNOWN, generator)
        rises = simplex.losses[1:] - simplex.losses[0]
        slope = rises / (simplex.points[1:] - simplex.points[0]).diagonal()
        slopes = torch.cat([sampled, slope[None]])
        known = replace(known, slopes=slopes)
        if float(slope.norm()) < _STEEP * _steepness(known, 0.0, self._beside):  # it is no kink
            return self._arrived(known, known.reason, generator)
        return self._measuring(known, generator)

    def more(self, known: MetricProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        return points[:0] if known.slopes is not None else super().more(known, points, count, generator)

    @property
    def _beside(self) -> float:
        return _BESIDE * self.settings.tolerance

    def _arrived(
        self, known: MetricProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[MetricProgress, Tensor]:
        if known.slopes is None and not known.is_lost and self._is_kink(known):
            nothing = known.root[:0]
            return self._measuring(replace(known, slopes=nothing, reason=reason), generator)
        return super()._arrived(replace(known, slopes=None), reason, generator, last=last)

    def _is_kink(self, known: MetricProgress) -> bool:
        """Whether the loss rises as steeply next to the best point as farther away, and no bound is near."""
        x, settings, tolerance = known.lowest.point, self.settings, self.settings.tolerance
        room = float(torch.minimum(x - settings.lower, settings.upper - x).min())
        if known.lowest.loss > known.best.loss or room <= max(_LENGTHS) * _AROUND * tolerance:
            return False
        apart = next(filter(None, (_steepness(known, a * tolerance, b * tolerance) for a, b in _APART)), 0.0)
        return _JUMP * apart > _steepness(known, 0.0, self._beside) > _STEEP * apart > 0.0

    def _measuring(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Ask for steps against the shortest vector of the hull, and for a further slope; end where it is zero."""
        x, slopes, n, distance = known.lowest.point, known.slopes, self._n, _AROUND * self.settings.tolerance
        assert slopes is not None
        steps = x[None][:0]
        if len(slopes) >= n:
            least = shortest(slopes)
            if float(least.norm()) <= _ZERO * float(slopes.norm(dim=1).mean()):
                return self._arrived(known, known.reason, generator)
            if len(slopes) >= _MOST * (n + 1):
                return self._ended(replace(known, slopes=None), None, _UNKNOWN, generator)
            lengths = torch.tensor(_LENGTHS, dtype=x.dtype, device=x.device)
            steps = x - distance * lengths[:, None] * torch.nn.functional.normalize(least, dim=0)
        corner = x + distance / math.sqrt(n) * normal(generator, x, n)
        sides = corner + _CLOSE * distance * torch.eye(n, dtype=x.dtype, device=x.device)
        return replace(known, phase="slope"), self.settings.inside(torch.cat([steps, corner[None], sides]))


def _steepness(known: MetricProgress, nearest: float, farthest: float) -> float:
    """Return how steeply the loss rises from the best point to evaluations between two distances, at most; or 0."""
    distance, rise = (known.points - known.lowest.point).norm(dim=1), known.values - known.lowest.loss
    told = (distance > nearest) & (distance <= farthest) & (rise > _ROUNDING * abs(known.lowest.loss))
    return float((rise[told] / distance[told]).max()) if bool(told.any()) else 0.0
