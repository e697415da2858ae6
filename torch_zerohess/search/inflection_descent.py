"""Descent on quadratics that does not take an inflection for a minimum.

At an inflection, as of x^3, slope and curvature are zero, and the steps of quadratics end there. So where the curvature
along some direction is next to nothing, the loss is evaluated at two points along it, one on each side. If one of them
is lower, the search goes on from there. At a minimum like that of x^4 both are higher.
"""

from dataclasses import replace

import torch
from torch import Tensor

from torch_zerohess.search.metric_progress import MetricProgress
from torch_zerohess.search.state import Evaluated
from torch_zerohess.search.two_sided_descent import TwoSidedQuadratics

_FLAT = 1e-4
"""Share of the largest curvature below which a curvature is next to nothing."""
_APART = 0.03
"""Least distance from the best point, over the first sigma, of evaluations that tell the largest curvature."""
_ASIDE = 0.1
"""Distance of the two points from the best point, over the first sigma."""
_GAIN = 1e-6
"""Least decrease of the loss that counts, over what the largest curvature adds at this distance."""


class InflectionQuadratics(TwoSidedQuadratics):
    """Descent on quadratics that looks to both sides of its end where the loss is flat there."""

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        if known.phase != "aside":
            return super().next(known, evaluated, generator)
        before, largest = known.lowest.loss, self._largest(known)
        known = known.remembered(evaluated, self._capacity)
        if known.lowest.loss >= before - _GAIN * largest * _ASIDE**2:
            return super()._arrived(known, known.reason, generator)
        return self._beside_end(known, _ASIDE, generator)

    def more(self, known: MetricProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        return points[:0] if known.phase == "aside" else super().more(known, points, count, generator)

    def _arrived(
        self, known: MetricProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[MetricProgress, Tensor]:
        if known.is_lost or last or (direction := self._flat(known)) is None:
            return super()._arrived(known, reason, generator, last=last)
        step = _ASIDE * direction
        points = self.settings.inside(known.lowest.point + torch.stack([step, -step]))
        return replace(known, phase="aside", reason=reason), points

    def _flat(self, known: MetricProgress) -> Tensor | None:
        """Return the direction [n] of the least curvature at the best point if that is next to nothing."""
        if known.lowest.loss > known.best.loss:
            return None
        curvatures, directions = torch.linalg.eigh(self._quadratic_at_end(known)[1])
        return directions[:, 0] if abs(float(curvatures[0])) < _FLAT * self._largest(known) else None

    def _largest(self, known: MetricProgress) -> float:
        """Return the largest curvature between the best point and an evaluation apart from it; 0 if there is none."""
        squares = (known.points - known.lowest.point).square().sum(1)
        apart = (squares >= _APART**2) & ~known.holes
        curvatures = 2.0 * (known.values[apart] - known.lowest.loss) / squares[apart]
        return float(curvatures.max()) if len(curvatures) else 0.0
