"""A Gaussian process of the loss that quadratics finish: `GaussianProcessSearch` where the black box returns the loss.

The process finds the way over plateaus and out of local minima (`ProcessMethod`), quadratics end it
(`LocalQuadratics`): a process that is to hold all over the box leaves a millionth of the loss unexplained, a quadratic
around a smooth minimum next to nothing.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.search.descent import LocalQuadratics
from torch_zerohess.search.descent_progress import DescentProgress
from torch_zerohess.search.process_method import APART, ProcessMethod
from torch_zerohess.search.process_progress import ProcessProgress
from torch_zerohess.search.protocol import Settings
from torch_zerohess.search.state import Best, Evaluated
from torch_zerohess.surrogates.quadratic import LocalModel

_NEAR = 0.1
"""Steps of the process below this length, in units of the first sigma sqrt(n),"""
_STEPS = 2
"""this many in a row, have found a basin."""
_WIDTH = 0.3
"""First sigma of the quadratics."""
_PATIENCE = 3
"""Evaluations over n + 1 in which one model must find something better, or it is the turn of the other."""
_FINEST = 1e-3
"""Sigma at which quadratics end, over the tolerance of the search, and the last step with which they have converged."""


@dataclass(frozen=True, eq=False, kw_only=True)
class LossProgress(ProcessProgress):
    """What the process knows, and what the quadratics know."""

    quadratics: DescentProgress | None = None
    """Also when they have ended."""
    finishing: bool = False
    """Whether it is the turn of the quadratics."""
    finished: Tensor
    """Where quadratics have ended [n]; infinite before."""
    steps: int = 0
    """Short steps of the process in a row."""
    waited: int = 0
    """Evaluations since something better was found."""


class LossProcess(ProcessMethod[LossProgress]):
    """A process of the loss and quadratics in turn."""

    progress = LossProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        tolerance = _FINEST * settings.tolerance
        self._finish = LocalQuadratics(replace(settings, restarts=0, tolerance=tolerance, pool=self.capacity))
        self._patience = _PATIENCE * (settings.n + 1)

    def first(self, generator: torch.Generator) -> tuple[LossProgress, Tensor]:
        nowhere = torch.full_like(self.settings.start, math.inf)
        known = LossProgress(**self.begun(), finished=nowhere)
        return self.points(known, generator)

    def next(
        self, known: LossProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LossProgress, Tensor]:
        if known.quadratics is not None and known.finishing:
            known = self._after_quadratics(known, known.quadratics, evaluated, generator)
        else:
            known = self._after_process(known, evaluated)
        if known.quadratics is not None and known.finishing and not known.done:
            return known, self._finish.points(known.quadratics, generator)
        return self.points(known, generator)

    def model_at_best(self, known: LossProgress) -> tuple[LocalModel, float] | None:
        quadratics = known.quadratics
        if quadratics is not None and torch.equal(quadratics.best.point, known.best.point):
            return self._finish.model_at_best(quadratics)
        return super().model_at_best(known)

    def _after_process(self, known: LossProgress, evaluated: Evaluated) -> LossProgress:
        """Let quadratics finish where the process has found a new basin, or finds nothing better."""
        before = known.best.loss
        known = self.take(known, evaluated)
        known = replace(
            known,
            steps=known.steps + 1 if known.moved < _NEAR else 0,
            waited=0 if known.best.loss < before else known.waited + len(evaluated),
        )
        new = float((known.best.point - known.finished).norm()) > APART
        turn = known.steps >= _STEPS or known.waited >= self._patience
        if not turn or not new or known.noisy or known.done:
            return known
        quadratics = self._finish.go_on(known.pool, Best(known.best.point, known.best.loss), _WIDTH)
        return replace(known, quadratics=quadratics, finishing=True, steps=0, waited=0)

    def _after_quadratics(
        self, known: LossProgress, before: DescentProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> LossProgress:
        """Let quadratics go on, and return to the process where they find nothing better."""
        now, finite = self._finish.take(before, evaluated, generator), evaluated.finite
        known = self.avoiding(known, evaluated.points[~finite])
        for k in finite.nonzero().flatten().tolist():  # what tells the process something new
            if float((known.pool.points - evaluated.points[k]).norm(dim=1).min()) > APART:
                known = self.remembered(known, evaluated.those(torch.tensor([k])))
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
            waited=0 if now.best.loss < before.best.loss else known.waited + len(evaluated),
        )
        if not now.done and known.waited < self._patience:
            return known
        converged = now.sigma * float(now.step.norm()) < _FINEST
        solved = best.point if converged else torch.full_like(best.point, math.inf)
        known = replace(known, finishing=False, finished=best.point, solved=solved, waited=0)
        finest = self._finish.settings.tolerance
        return self.arrived(known, f"quadratics reached {finest} of sigma or found nothing better for a while")
