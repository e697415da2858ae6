"""A Gaussian process of the loss that quadratics finish: `GaussianProcessSearch` where the black box returns the loss.

The process crosses plateaus and leaves local minima (`ProcessMethod`). Quadratics finish (`MetricQuadratics`): a
process of the whole box leaves a millionth of the loss unexplained, a quadratic around a smooth minimum next to
nothing. If a function has more minima than the process can tell apart, the process finds nothing better. Then
quadratics begin at a random point of the box.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.search.method import Settings
from torch_zerohess.search.metric_descent import MetricProgress, MetricQuadratics
from torch_zerohess.search.process_method import APART, ROUND, ProcessMethod
from torch_zerohess.search.process_progress import ProcessProgress
from torch_zerohess.search.state import Evaluated
from torch_zerohess.surrogates.quadratic import LocalModel

_NEAR = 0.1
"""Steps of the process below this length, in units of the first sigma sqrt(n),"""
_STEPS = 2
"""this many in a row, have found a basin."""
_WIDTH = 0.3
"""First sigma of the quadratics."""
_PATIENCE, _QUADRATIC_PATIENCE = 3, 5
"""Evaluations over n + 1 in which the process, and the quadratics, must find something better: a curved valley refuses
several steps in a row."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LossProgress(ProcessProgress):
    """What the process knows, and what the quadratics know."""

    quadratics: MetricProgress | None = None
    """Also when they have ended."""
    finishing: bool = False
    """Whether it is the turn of the quadratics."""
    finished: Tensor
    """Where quadratics have ended [n]; infinite before."""
    steps: int = 0
    """Short steps of the process in a row."""
    waited: int = 0
    """Evaluations since something better was found."""

    def is_minimum(self, tolerance: float) -> bool:
        return torch.equal(self.solved, self.best.point) and ProcessProgress.is_minimum(self, tolerance)


class LossProcess(ProcessMethod[LossProgress]):
    """A process of the loss and quadratics in turn."""

    progress = LossProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._finish = MetricQuadratics(replace(settings, restarts=0))
        self._patience = _PATIENCE * (settings.n + 1)

    def first(self, generator: torch.Generator) -> tuple[LossProgress, Tensor]:
        nowhere = torch.full_like(self.settings.start, math.inf)
        known = LossProgress(**self.begun(), finished=nowhere)
        return self.points(known, generator)

    def next(
        self, known: LossProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        if known.quadratics is not None and known.finishing:
            known, points = self._after_quadratics(known, known.quadratics, evaluated, generator)
        else:
            known, points = self._after_process(known, evaluated, generator)
        return (known, points) if known.finishing else self.points(known, generator)

    def more(self, known: LossProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if known.quadratics is not None and known.finishing:
            return self._finish.more(known.quadratics, points, count, generator)
        return super().more(known, points, count, generator)

    def model_at_best(self, known: LossProgress) -> tuple[LocalModel, float] | None:
        quadratics = known.quadratics
        if quadratics is not None and torch.equal(quadratics.best.point, known.best.point):
            return self._finish.model_at_best(quadratics)
        return super().model_at_best(known)

    def _after_process(
        self, known: LossProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        """Let quadratics finish a new basin; where the process finds none, let them begin elsewhere in the box."""
        before, count = known.best.loss, len(evaluated.needed)
        known = self.take(known, evaluated)
        known = replace(
            known,
            steps=known.steps + 1 if known.moved < _NEAR else 0,
            waited=0 if known.best.loss < before else known.waited + count,
        )
        nothing = evaluated.points[:0]
        new = float((known.best.point - known.finished).norm()) > APART
        turn = known.steps >= _STEPS or known.waited >= self._patience
        if not turn or known.noisy or known.done:
            return known, nothing
        if new:
            begun = self._finish.go_on(known.pool.points, known.pool.values, known.best, _WIDTH)
            quadratics, points = self._finish.plan(begun, generator)
        else:
            quadratics, points = self._finish.elsewhere(generator)
        return replace(known, quadratics=quadratics, finishing=True, steps=0, waited=0), points

    def _after_quadratics(
        self, known: LossProgress, before: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        """Let quadratics go on, and return to the process where they find nothing better."""
        finite = evaluated.finite
        now, points = self._finish.next(before, evaluated, generator)
        known = self.avoiding(known, evaluated.points[~finite])
        for k in finite.nonzero().flatten().tolist():  # what tells the process something new
            if float((known.pool.points - evaluated.points[k]).norm(dim=1).min()) > APART:
                known = self.remembered(known, evaluated.those(slice(k, k + 1)))
        best = now.best if now.best.loss <= known.best.loss else known.best
        known = replace(
            known,
            best=best,
            record=best if best is now.best else known.record,
            center=now.center,
            sigma=now.sigma,
            quadratics=now,
            evaluations=known.evaluations + len(evaluated),
            iterations=known.iterations + now.iterations - before.iterations,
            waited=0 if now.best.loss < before.best.loss else known.waited + len(evaluated.needed),
        )
        plateau = now.wide is not None  # the process leaves it sooner
        patient = known.waited < _QUADRATIC_PATIENCE * (self.settings.n + 1)
        if not now.done and not plateau and patient:
            return known, points
        converged = now.done and not now.lost
        if best is now.best:
            solved = best.point if converged else torch.full_like(best.point, math.inf)
            known = replace(known, finished=best.point, solved=solved)
        known = replace(known, finishing=False, waited=0)
        if plateau or (best is not now.best and not converged):  # they have found no minimum
            return replace(known, settled=0, exploring=ROUND * self.settings.n), points
        known = self.arrived(known, "quadratics have arrived or found nothing better for a while")
        other = float((now.best.point - best.point).norm()) > APART
        return (replace(known, agreed=0) if other else known), points
