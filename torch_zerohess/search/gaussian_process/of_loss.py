"""A Gaussian process of the loss that quadratics finish: `GaussianProcessSearch` where the black box returns the loss.

Quadratics are fitted next to the minimum (`LossQuadratics`). They begin where the steps of the process are short, or
where a quadratic has predicted the end of a step. If a function has more minima than the process can tell apart, the
process finds nothing better. Then quadratics begin at a random point of the box. Lower minima are often close to each
other: while arrivals disagree, quadratics begin beside the best point every other time (monotonic basin hopping: Wales
and Doye 1997, Leary 2000). Where the loss is a sum of functions of one parameter, the axes are searched instead
(`AxisSearch`).
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.search.descent.axis_search import AxisLines, AxisSearch
from torch_zerohess.search.descent.metric_progress import MetricProgress
from torch_zerohess.search.descent.of_loss import LossQuadratics
from torch_zerohess.search.gaussian_process.finish import PATIENCE, FinishedProcess, FinishedProgress
from torch_zerohess.search.gaussian_process.method import APART, ROUND
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.random_points import fractions, uniform
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import LOST, Evaluated
from torch_zerohess.surrogates.quadratic import LocalModel, coefficient_count

_NEAR = 0.1
"""Length below which a step of the process is short, in units of the first sigma sqrt(n)."""
_STEPS = 2
"""Short steps in a row that have found a basin."""
_FORETOLD = 0.1
"""Error of a predicted loss, over the change of the loss, up to which one step has found a basin."""
_WIDTH = 0.3
"""First sigma of the quadratics."""
_HOPS = (0.5, 2.0)
"""Shortest and longest standard deviation of a hop from the best point, in units of the first sigma."""
_HOP_WIDTH = 0.3
"""First sigma of the quadratics that begin after a hop, over the standard deviation of the hop."""
_PATIENCE = 5
"""Evaluations over n + 1 in which the quadratics must find something better: a curved valley refuses several steps."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LossProgress(FinishedProgress):
    """What the process knows, and what the quadratics know."""

    local: MetricProgress | None = None
    steps: int = 0
    """Short steps of the process in a row."""
    foretold: float = math.inf
    """Loss that a quadratic predicts for the point that is asked for; infinite where it is not determined."""
    beside: bool = False
    """Whether the latest quadratics have begun beside the best point. Such quadratics confirm no minimum."""
    several: bool = False
    """Whether quadratics have arrived at several minima."""
    lines: AxisLines | None = None
    """What is known along the axes; None before it is asked for."""

    @property
    def handed_over(self) -> bool:
        return self.finishing or (self.lines is not None and self.lines.asks)

    def is_minimum(self, tolerance: float) -> bool:
        return self.is_solved and super().is_minimum(tolerance)


class LossProcess(FinishedProcess[LossProgress]):
    """A process of the loss and quadratics in turn."""

    progress = LossProgress
    local: LossQuadratics

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self.local = LossQuadratics(replace(settings, restarts=0))
        self._axes = AxisSearch(settings)

    def model_at_best(self, known: LossProgress) -> tuple[LocalModel, float] | None:
        quadratics = known.local
        if quadratics is not None and torch.equal(quadratics.best.point, known.best.point):
            return self.local.model_at_best(quadratics)
        return super().model_at_best(known)

    def next(
        self, known: LossProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        if known.lines is None or not known.lines.asks:
            return super().next(known, evaluated, generator)
        known, points = self._along_axes(known, known.lines, evaluated, generator)
        return (known, points) if len(points) else self.points(known, generator)

    def more(self, known: LossProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if known.lines is not None and known.lines.asks:
            return self._axes.more(known.lines, count)
        return super().more(known, points, count, generator)

    def gives_up(self, known: LossProgress) -> bool:
        """Whether it ends. It does only with less than two values: with more of them quadratics go on."""
        return super().gives_up(known) and len(known.pool) < 2

    def points(self, known: LossProgress, generator: torch.Generator) -> tuple[LossProgress, Tensor]:
        known, points = super().points(known, generator)
        return replace(known, foretold=self._foretold(known, points)), points

    def _foretold(self, known: LossProgress, points: Tensor) -> float:
        """Return the loss that a quadratic predicts at the first of the points; infinity if it is not determined."""
        pool = known.pool
        if known.done or known.noisy or len(pool) < coefficient_count(self.settings.n):
            return math.inf
        quadratics = self.local.go_on(pool.points, pool.values, known.best, 1.0)
        return self.local.predicted(quadratics, points[0])

    def after_process(
        self, known: LossProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        """Let quadratics finish a new basin; if there is none, let them begin elsewhere or beside the best point."""
        before, count = known.best.loss, len(evaluated.needed)
        told = float(evaluated.losses[0])
        foretold = math.isfinite(told + before) and abs(told - known.foretold) < _FORETOLD * abs(told - before)
        known = self.take(known, evaluated)
        known = replace(
            known,
            steps=known.steps + 1 if known.moved < _NEAR else 0,
            waited=0 if known.best.loss < before else known.waited + count,
        )
        turn = known.steps >= _STEPS or known.waited >= PATIENCE * (self.settings.n + 1)
        turn = turn or known.lost >= LOST or (foretold and self.is_new(known))
        if not turn or known.noisy or known.done:
            return known, evaluated.points[:0]
        if self.is_new(known):
            begun = self.local.go_on(known.pool.points, known.pool.values, known.best, _WIDTH).avoiding(known.holes)
            return _finishing(known, *self.local.plan(begun, generator))
        if self._axes.may_begin(known.lines, several=known.several):
            lines, points = self._axes.begin(known.lines, known.best, known.pool.points, known.pool.values)
            return replace(known, lines=lines, steps=0), points
        if known.finished is not None and known.agreed == 0 and not known.beside:
            return _finishing(known, *self._hop(known, generator), beside=True)
        return self._elsewhere(known, generator)

    def _along_axes(
        self, known: LossProgress, lines: AxisLines, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        """Let the search along the axes learn; when it has ended let quadratics begin where the loss is lowest."""
        before = known.best
        known = self.learned(known, evaluated)
        known = replace(known, best=before.or_lower(evaluated.sound, known.sigma))
        known = replace(known, record=known.best, evaluations=known.evaluations + len(evaluated))
        lines, points = self._axes.next(lines, evaluated, several=known.several)
        known = replace(known, lines=lines)
        if lines.asks:
            return known, points
        if lines.stage == "lower":
            return _finishing(known, *self.local.begin(lines.lowest, min(lines.spacing, 1.0), generator))
        if lines.stage == "level":
            return self.arrived(known, "nothing is lower along the axes"), points
        return self._elsewhere(known, generator)

    def _elsewhere(self, known: LossProgress, generator: torch.Generator) -> tuple[LossProgress, Tensor]:
        """Let quadratics begin at a random point of the box."""
        center = uniform(generator, self.settings.lower, self.settings.upper, 1)[0]
        return _finishing(known, *self.local.begin(center, 1.0, generator))

    def _hop(self, known: LossProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        """Let quadratics begin beside the best point."""
        shortest, longest = _HOPS
        hop = shortest * (longest / shortest) ** float(fractions(generator))
        (center,) = self.settings.drawn(known.best.point, hop, 1, generator)
        return self.local.begin(center, _HOP_WIDTH * hop, generator)

    def after_local(
        self, known: LossProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        """Let quadratics go on, and return to the process where they find nothing better."""
        assert known.local is not None
        now, points = self.local.next(known.local, evaluated, generator)
        known = self.told(known, now, evaluated)
        best = known.best
        plateau = now.wide is not None  # the process leaves it sooner
        looks = now.slopes is not None or now.phase == "aside"  # around where they may have arrived
        looks = looks or now.border is not None  # steps beside a border fail half of the time
        patient = looks or known.waited < _PATIENCE * (self.settings.n + 1)
        if not now.done and not plateau and patient:
            return known, points
        # The end beside a border is no minimum: evaluations may not show how the border goes on.
        converged = now.done and now.arrivals.lowest is not None and now.border is None
        if best is now.best:
            known = replace(known, finished=best.point, solved=best.point if converged else None)
        known = replace(known, finishing=False, waited=0)
        if plateau or (best is not now.best and not converged):  # they have found no minimum
            return replace(known, settled=0, exploring=ROUND * self.settings.n), points
        elsewhere = float((now.best.point - best.point).norm()) > APART
        end = now.best if elsewhere and converged else None
        reason = "quadratics have arrived" if converged else "quadratics found nothing better for a while"
        known = self.arrived(known, reason, end)
        known = replace(known, several=known.several or (end is not None and known.agreed == 0))
        if known.beside or (elsewhere and not converged):
            return known.with_arrivals(agreed=0), points
        return known, points


def _finishing(
    known: LossProgress, quadratics: MetricProgress, points: Tensor, *, beside: bool = False
) -> tuple[LossProgress, Tensor]:
    """Return the progress when quadratics have begun, and their points."""
    return replace(known, local=quadratics, finishing=True, beside=beside, steps=0, waited=0, lost=0), points
