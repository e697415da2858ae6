"""A check of the end of a round: no kink is taken for a minimum.

Near a kink the quadratics of a loss predict nothing, and their region shrinks wherever it is. So where the loss rises
as steeply beside the best point as farther away, slopes are measured at random points around it, and their convex hull
is looked at (gradient sampling: Burke, Lewis and Overton 2005). If the shortest vector of the hull is zero, the best
point is stationary. Otherwise its opposite is a direction of descent, and the search goes on from a lower point there.

A penalty may be 10 000 times as steep on one side of a kink as the loss on the other side. The gentle slopes then tell
whether the best point is a minimum.
"""

import math
from typing import Literal

import torch
from torch import Tensor

from torch_zerohess.linalg.hull import shortest
from torch_zerohess.search.descent.metric_progress import MetricProgress
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.random_points import normal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated

_BESIDE, _APART = 1e-4, ((1e-2, 1.0), (1.0, math.inf))
"""Distances over the tolerance up to which an evaluation is beside the best point, and between which it is apart; the
second ones where there are none between the first ones."""
_STEEP = 1e-2
"""There is no kink where the loss rises less steeply beside the best point than this share of the steepest rise apart
from it. A slope is gentle if its length is less than this share of the steepest rise beside the best point."""
_BENT = 30.0
"""The rise to the first corner is compared with the rise to an evaluation beside the best point, in the same direction.
At a kink the first is at most 30 times as steep as the second, and at least a thirtieth. A smooth loss rises 100 times
as steeply to the corner, and a loss that jumps a hundredth."""
_ENOUGH = 8
"""Evaluations beside the best point, and apart from it, that are needed before their medians decide whether there is a
kink."""
_STRADDLED = 0.1
"""Error of a slope over its length, at most, unless the slope is gentle. Differences across a kink do not
estimate a slope."""
_ROUNDING = 1e4 * torch.finfo(torch.float64).eps
"""Rise, relative to the loss, up to which it may be rounding."""
_AROUND, _CLOSE = 1e-2, 1e-2
"""Distance over the tolerance of the points whose slopes are measured; that of the differences, over this distance."""
_MOST = 6
"""Slopes that are measured, over n + 1, at most."""
_ZERO = 1e-3
"""Length of a vector in the hull that counts as zero, over the length of the shortest slope."""
_LENGTHS = (0.3, 1.0, 3.0, 10.0, 100.0, 1e3, 1e4)
"""Steps that are tried, against the shortest vector of the hull, over the distance of the points whose slopes are
measured."""
_ROOM = 3.0
"""No slopes are measured if a bound is nearer than this, over the same distance."""

Verdict = Literal["open", "end", "unknown"]
"""Whether more points are asked for around a kink, whether no slope there leads down, or whether the slopes do not
decide."""


class KinkCheck:
    """Whether the end of a round is a kink, and whether the loss falls from there.

    Its questions are answered by the evaluations of the round, and by slopes around its end (`MetricProgress.slopes`).
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._beside = _BESIDE * settings.tolerance

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[Verdict, MetricProgress, Tensor]:
        """Judge by one more slope, of an evaluation that found nothing lower. Return the next points [K, n], too."""
        n, slopes, nothing = self._settings.n, known.slopes, evaluated.points[:0]
        assert slopes is not None
        simplex = evaluated.needed.those(slice(-n - 1, None))
        complete = len(evaluated.needed) == n + 1 + (len(_LENGTHS) if len(slopes) >= n else 0)
        if not bool(evaluated.finite.all()):  # it is a border
            return "end", known, nothing
        if not complete:
            return "unknown", known, nothing
        rises = simplex.losses[1:] - simplex.losses[0]
        slope = rises / (simplex.points[1:] - simplex.points[0]).diagonal()
        if not len(slopes):
            if not self._is_straight(known, simplex):
                return "end", known, nothing
        elif self._is_straddled(known, simplex, slope):
            slope = slopes[-1]  # nothing new
        return self.measuring(known, torch.cat([slopes, slope[None]]), generator)

    def is_kink(self, known: MetricProgress) -> bool:
        """Whether the loss rises as steeply next to the best point as farther away, and no bound is near."""
        x, settings = known.lowest.point, self._settings
        room = float(torch.minimum(x - settings.lower, settings.upper - x).min())
        if known.lowest.loss > known.best.loss or room <= _ROOM * _AROUND * settings.tolerance:
            return False
        beside, apart = self._beside_and_apart(known)
        if not len(apart) or not len(beside):
            return False
        return bool(beside.max() > _STEEP * apart.max()) or bool(beside.median() > _STEEP * apart.median())

    def _beside_and_apart(self, known: MetricProgress) -> tuple[Tensor, Tensor]:
        """Return how steeply the loss rises to evaluations beside the best point, and to those apart from it."""
        tolerance = self._settings.tolerance
        ranges = ((a * tolerance, b * tolerance) for a, b in _APART)
        apart = next(filter(len, (_rises(known, *one)[1] for one in ranges)), known.values[:0])
        return _rises(known, 0.0, self._beside)[1], apart

    def _is_straddled(self, known: MetricProgress, simplex: Evaluated, slope: Tensor) -> bool:
        """Whether a slope [n] does not lead back to the best loss: its corners are on two sides of a kink."""
        away = simplex.points[0] - known.lowest.point
        error = float(simplex.losses[0]) - known.lowest.loss - float(slope @ away)
        steep = float(slope.norm()) > _STEEP * float(_rises(known, 0.0, self._beside)[1].max())
        return steep and abs(error) > _STRADDLED * float(slope.norm() * away.norm())

    def _is_straight(self, known: MetricProgress, simplex: Evaluated) -> bool:
        """Whether the loss rises as steeply to the first corner as next to the best point, in the same direction.

        Or whether most of the evaluations beside it show a rise as steep as most of those apart from it, if there are
        enough, and no evaluation shows a jump. The corner is then on the steep side of a kink.
        """
        rise = float(simplex.losses[0]) - known.lowest.loss
        steepness = rise / float((simplex.points[0] - known.lowest.point).norm())
        beside, apart = self._beside_and_apart(known)
        steepest = float(beside.max())
        enough = min(len(beside), len(apart)) >= _ENOUGH and steepest < _BENT * float(apart.max())
        if enough and 1.0 / _BENT < float(beside.median() / apart.median()) < _BENT:
            return True
        return steepest / _BENT < steepness < _BENT * steepest

    def measuring(
        self, known: MetricProgress, slopes: Tensor, generator: torch.Generator
    ) -> tuple[Verdict, MetricProgress, Tensor]:
        """Ask for a further slope and, from n slopes [m, n] on, for steps against the shortest vector of their hull."""
        x, n, distance = known.lowest.point, self._settings.n, _AROUND * self._settings.tolerance
        steps = x[None][:0]
        if len(slopes) >= n:
            least = shortest(slopes)
            if float(least.norm()) <= _ZERO * float(slopes.norm(dim=1).min()):
                return "end", known, steps
            if len(slopes) >= _MOST * (n + 1):
                return "unknown", known, steps
            lengths = torch.tensor(_LENGTHS, dtype=x.dtype, device=x.device)[:, None]
            steps = x - distance * lengths * torch.nn.functional.normalize(least, dim=0)
        towards = normal(generator, x, n) / math.sqrt(n)
        if not len(slopes):
            points, steepness = _rises(known, 0.0, self._beside)
            towards = torch.nn.functional.normalize(points[int(steepness.argmax())] - x, dim=0)
        corner = x + distance * towards
        sides = corner + _CLOSE * distance * torch.eye(n, dtype=x.dtype, device=x.device)
        points = self._settings.inside(torch.cat([steps, corner[None], sides]))
        return "open", replace(known, phase="slope", slopes=slopes), points


def _rises(known: MetricProgress, nearest: float, farthest: float) -> tuple[Tensor, Tensor]:
    """Return to which evaluations [k, n] between two distances the loss rises, and how steeply [k]."""
    distance, rise = (known.points - known.lowest.point).norm(dim=1), known.values - known.lowest.loss
    told = (distance > nearest) & (distance <= farthest) & (rise > _ROUNDING * abs(known.lowest.loss))
    return known.points[told], (rise / distance)[told]
