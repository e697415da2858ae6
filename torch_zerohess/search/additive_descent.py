"""Descent on quadratics that searches the axes between its rounds where the loss is a sum (`AxisSearch`)."""

from dataclasses import replace

import torch
from torch import Tensor

from torch_zerohess.search.axis_search import AxisSearch
from torch_zerohess.search.kinked_descent import KinkedQuadratics
from torch_zerohess.search.method import Settings
from torch_zerohess.search.metric_progress import MetricProgress
from torch_zerohess.search.state import Evaluated


class AdditiveQuadratics(KinkedQuadratics):
    """The method of `Descent` for a loss alone without noise, of up to 200 parameters."""

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._axes = AxisSearch(settings)

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        lines = known.lines
        if lines is None or not lines.asks:
            return super().next(known, evaluated, generator)
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

    def more(self, known: MetricProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if known.lines is not None and known.lines.asks:
            return self._axes.more(known.lines, count)
        return super().more(known, points, count, generator)

    def _further(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        if not len(known.points) or not self._axes.may_begin(known.lines, several=_are_several(known)):
            return super()._further(known, generator)
        lines, points = self._axes.begin(known.lines, known.best, known.points, known.values)
        return replace(known, lines=lines, phase="lines"), points


def _are_several(known: MetricProgress) -> bool:
    """Whether rounds have arrived at several minima."""
    return known.arrivals.lowest is not None and known.agreed == 0
