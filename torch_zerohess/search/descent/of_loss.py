"""Descent on quadratics of a loss alone, with checks at the end of every round.

A round has arrived once its end is neither a kink from which the loss falls (`KinkCheck`) nor an inflection. Before the
next round the axes are searched where the loss is a sum (`AxisSearch`).
"""

import torch
from torch import Tensor

from torch_zerohess.search.descent.axis_search import AxisLines, AxisSearch
from torch_zerohess.search.descent.inflection import ASIDE, both_sides, least_gain
from torch_zerohess.search.descent.kink import KinkCheck, Verdict
from torch_zerohess.search.descent.metric_progress import MetricProgress
from torch_zerohess.search.descent.two_sided import TwoSidedQuadratics
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated

_UNKNOWN = "the slopes around a kink do not show whether it is a minimum"


class LossQuadratics(TwoSidedQuadratics):
    """The method of `Descent` for a loss alone without noise, of up to 200 parameters."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._kinks, self._axes = KinkCheck(settings), AxisSearch(settings)

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        if known.slopes is not None:
            return self._after_slopes(known, evaluated, generator)
        if known.phase == "aside":
            return self._after_both_sides(known, evaluated, generator)
        if known.lines is not None and known.lines.asks:
            return self._along_axes(known, known.lines, evaluated, generator)
        return super().next(known, evaluated, generator)

    def more(self, known: MetricProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if known.slopes is not None or known.phase == "aside":
            return points[:0]
        if known.lines is not None and known.lines.asks:
            return self._axes.more(known.lines, count)
        return super().more(known, points, count, generator)

    # Checks of the end of a round.

    def _arrived(
        self, known: MetricProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[MetricProgress, Tensor]:
        """Look at a kink; then, or elsewhere, to both sides where the loss is flat; then the round has arrived."""
        if known.is_lost:
            return super()._arrived(known, reason, generator, last=last)
        known = replace(known, reason=reason)
        if self._kinks.is_kink(known):
            return self._judging(*self._kinks.measuring(known, known.root[:0], generator), generator)
        return self._looking_aside(known, generator)

    def _after_slopes(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Go on from a lower point beside the kink, or judge the kink by one more slope."""
        after = known.remembered(evaluated, self._capacity)
        if after.lowest.loss < known.lowest.loss:
            step = float((after.lowest.point - known.lowest.point).norm())
            return self._beside_end(replace(after, slopes=None), step, generator)
        known = replace(known, evaluations=after.evaluations)
        return self._judging(*self._kinks.next(known, evaluated, generator), generator)

    def _judging(
        self, verdict: Verdict, known: MetricProgress, points: Tensor, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Ask for points around the kink, or end there."""
        if verdict == "open":
            return known, points
        known = replace(known, slopes=None)
        if verdict == "unknown":
            return self._ended(known, None, _UNKNOWN, generator)
        return self._looking_aside(known, generator)

    def _looking_aside(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Ask for a point on both sides if the loss is flat along some direction; otherwise the round has arrived."""
        sides = None if known.lowest.loss > known.best.loss else both_sides(known, self._quadratic_at_end(known)[1])
        if sides is None:
            return super()._arrived(known, known.reason, generator)
        return replace(known, phase="aside"), self.settings.inside(sides)

    def _after_both_sides(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Go on from one of the two points if it is lower; otherwise the round has arrived."""
        enough = known.lowest.loss - least_gain(known)
        known = known.remembered(evaluated, self._capacity)
        if known.lowest.loss >= enough:
            return super()._arrived(known, known.reason, generator)
        return self._beside_end(known, ASIDE, generator)

    # Axes.

    def _further(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        if not len(known.points) or not self._axes.may_begin(known.lines, several=_are_several(known)):
            return super()._further(known, generator)
        lines, points = self._axes.begin(known.lines, known.best, known.points, known.values)
        return replace(known, lines=lines, phase="lines"), points

    def _along_axes(
        self, known: MetricProgress, lines: AxisLines, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Let the search along the axes learn; when it has ended begin a round where the loss is lowest."""
        before = known.best
        known = replace(known.remembered(evaluated, self._capacity), lost=0)
        lines, points = self._axes.next(lines, evaluated, several=_are_several(known))
        known = replace(known, lines=lines)
        if lines.asks:
            return known, points
        if lines.stage == "lower":
            return self._round_at(known, lines.lowest, min(lines.spacing, 1.0), generator)
        if known.best is not before:
            return self._round_at(known, known.best.point, 1.0, generator)
        if lines.stage == "level":  # as good as a round that has arrived at the best point
            known = known.agreeing(known.best, self.settings.tolerance, known.values)
            known = known.ended_round("nothing is lower along the axes", self.settings.restarts)
        return (known, points) if known.done else self._further(known, generator)


def _are_several(known: MetricProgress) -> bool:
    """Whether rounds have arrived at several minima."""
    return known.arrivals.lowest is not None and known.agreed == 0
