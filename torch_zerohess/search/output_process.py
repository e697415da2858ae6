"""A Gaussian process of the output that Gauss-Newton finishes: `GaussianProcessSearch` where there is a loss.

The process crosses plateaus and leaves local minima (`ProcessMethod`). It leaves a millionth of a smooth output
unexplained, and the loss stops there. Outputs interpolated next to the minimum leave nothing (`OutputGaussNewton`). If
steps of Gauss-Newton do not keep their promise, as where outputs jump, the process goes on alone. On a plateau with
ripples each step finds something a little better. Where nothing much better comes, the process looks where it knows
least.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.search.method import Settings
from torch_zerohess.search.output_gauss_newton import OutputGaussNewton, OutputProgress
from torch_zerohess.search.process_method import APART, FLOOR, ROUND, ProcessMethod
from torch_zerohess.search.process_progress import ProcessProgress
from torch_zerohess.search.state import Evaluated

_PATIENCE = 3
"""Evaluations over n + 1 in which the process must find something better."""
_STUCK, _BETTER = 4, 0.1
"""Evaluations over n + 1 after which it looks elsewhere, if none of them took away this part of the loss."""
_REFUSED = 2
"""Refused steps in a row of Gauss-Newton after which the process goes on."""
_WORTH = 0.1
"""Part of the loss that the first step of Gauss-Newton must promise to take away."""
_WIDEST = 0.3
"""First region of Gauss-Newton, at most."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputProcessProgress(ProcessProgress):
    """What the process knows, and what Gauss-Newton knows."""

    newton: OutputProgress | None = None
    """Also when it has ended."""
    finishing: bool = False
    """Whether it is the turn of Gauss-Newton."""
    tried: Tensor
    """Where Gauss-Newton has ended [n]; infinite before."""
    waited: int = 0
    """Evaluations since something better was found."""
    stuck: int = 0
    """Evaluations since something much better was found."""
    looks: int = 0
    """Times that it has looked elsewhere since then; each time it waits twice as long."""
    lost: bool = False
    """Whether it looks where it knows least, because nothing much better was found."""
    due: str = ""
    """Why the process has arrived; empty if it has not."""


class OutputProcess(ProcessMethod[OutputProcessProgress]):
    """A process of the output and Gauss-Newton in turn."""

    progress = OutputProcessProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._finish = OutputGaussNewton(replace(settings, restarts=0), self.capacity, _REFUSED)

    def first(self, generator: torch.Generator) -> tuple[OutputProcessProgress, Tensor]:
        nowhere = torch.full_like(self.settings.start, math.inf)
        return self.points(OutputProcessProgress(**self.begun(), tried=nowhere), generator)

    def next(
        self, known: OutputProcessProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        if known.newton is not None and known.finishing:
            known, points = self._after_newton(known, known.newton, evaluated, generator)
        else:
            known, points = self._after_process(known, evaluated, generator)
        return (known, points) if known.finishing else self.points(known, generator)

    def more(self, known: OutputProcessProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if known.newton is not None and known.finishing:
            return self._finish.more(known.newton, points, count, generator)
        return super().more(known, points, count, generator)

    def arrived(self, known: OutputProcessProgress, reason: str) -> OutputProcessProgress:
        """Note it: Gauss-Newton may go on from there."""
        return replace(known, due=reason)

    def explores(self, known: OutputProcessProgress) -> bool:
        return super().explores(known) or (known.exploring > 0 and known.lost)

    def _after_process(
        self, known: OutputProcessProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        before, nothing = known.best.loss, evaluated.points[:0]
        known = self.take(replace(known, due=""), evaluated)
        now, count = known.best.loss, len(evaluated.needed)
        better = now < before - _BETTER * abs(before)
        known = replace(
            known,
            waited=0 if now < before else known.waited + count,
            stuck=0 if better else known.stuck + count,
            looks=0 if better else known.looks,
        )
        n = self.settings.n
        turn = bool(known.due) or known.waited >= _PATIENCE * (n + 1)
        new = float((known.best.point - known.tried).norm()) > APART
        if turn and new and not known.noisy and not known.done and len(known.pool) > n:
            distance = (known.pool.points - known.best.point).norm(dim=1).sort().values[n]
            sigma = min(max(float(distance), self.settings.tolerance), _WIDEST)
            begun = self._finish.taking_over(known, known.best, sigma)
            newton, points = self._finish.plan(begun, generator)
            if len(points) and newton.promised > _WORTH * abs(known.best.loss):
                return replace(known, newton=newton, finishing=True, waited=0), points
            known = replace(known, tried=known.best.point)
        if known.due:
            return super().arrived(known, known.due), nothing
        if known.stuck == 0 or known.exploring == 0:
            known = replace(known, lost=False)
        if known.stuck < (_STUCK * (n + 1)) << known.looks:
            return known, nothing
        return replace(known, exploring=ROUND * n, stuck=0, lost=True, looks=known.looks + 1), nothing

    def _after_newton(
        self, known: OutputProcessProgress, before: OutputProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        """Let Gauss-Newton go on, and return to the process where it ends."""
        now, points = self._finish.next(before, evaluated, generator)
        known = self.avoiding(known, evaluated.points[~evaluated.finite])
        for k in evaluated.finite.nonzero().flatten().tolist():  # what tells the process something new
            if float((known.pool.points - evaluated.points[k]).norm(dim=1).min()) > APART:
                known = self.remembered(known, evaluated.those(slice(k, k + 1)))
        best = now.best if now.best.loss <= known.best.loss else known.best
        known = replace(
            known,
            best=best,
            record=best if best is now.best else known.record,
            center=now.center,
            sigma=max(now.sigma, FLOOR * self.settings.tolerance),
            refused=now.lost,
            newton=now,
            evaluations=known.evaluations + len(evaluated),
            iterations=known.iterations + now.iterations - before.iterations,
        )
        if not now.done and not now.failed:
            return known, points
        solved = best.point if now.done else torch.full_like(best.point, math.inf)
        known = replace(known, finishing=False, tried=best.point, solved=solved)
        if not known.due and not now.done:
            return known, points
        return super().arrived(known, known.due or "steps of Gauss-Newton have arrived"), points
