"""A Gaussian process of the output that Gauss-Newton finishes: `GaussianProcessSearch` where there is a loss.

Gauss-Newton interpolates outputs next to the minimum (`OutputGaussNewton`). Where it promises much after the first
samples, as for smooth outputs, it begins at once. If its steps do not keep their promise, as where outputs jump, the
process goes on alone. Gauss-Newton begins again once its first step promises more than an evaluation of the process has
gained in the meantime, or once the search would end. On a plateau with ripples each step of the process finds something
a little better. Where nothing much better comes, the process looks where it knows least.

The process believes most in the minimum that it knows, and may never look where another one is. Once Gauss-Newton has
arrived, it therefore begins again at random points of the box. Such a round is independent of the evaluations before.
It ends early where it leads to the best point, or where its model has a minimum that is higher. A round that arrives at
a higher minimum does not count against the best point.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.search.gauss_newton.by_interpolation import OutputGaussNewton, OutputProgress
from torch_zerohess.search.gaussian_process.finish import PATIENCE, FinishedProcess, FinishedProgress
from torch_zerohess.search.gaussian_process.method import APART, ROUND
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import EQUAL, Best, Evaluated, Progress
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel

_STUCK, _BETTER = 4, 0.1
"""Evaluations over n + 1 after which it looks elsewhere, if none of them took away this part of the loss."""
_PATIENCE = 2
"""Rejected steps in a row of Gauss-Newton after which the process goes on, if none before them was good."""
_WORTH = 0.1
"""Part of the loss that the first step of Gauss-Newton must promise to take away."""
_WORTH_EARLY = 0.3
"""`_WORTH` right after the first samples. Where outputs have nothing in common, as images of objects that do not
overlap, an affine output promises to fade the object out: up to a quarter."""
_ARRIVED, _STRAIGHT = 1e-8, 0.01
"""`_WORTH` where the process has arrived, and the search would end; or where the loss falls nearly straight along the
step: its curvature takes away less than the second part of the promise."""
_WIDEST = 0.3
"""First region of Gauss-Newton, at most."""
_ELSEWHERE = 2
"""Rounds of Gauss-Newton from random points in a row, before it is the turn of the process."""
_HIGHER = 0.01
"""A round ends where it promises less than this part of its distance from the lowest loss."""
_ROUGH = 0.01
"""Part of the loss, at most, that rough outputs add to it or take away next to the end of Gauss-Newton."""
_ARRIVAL = "steps of Gauss-Newton have arrived"


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputProcessProgress(FinishedProgress):
    """What the process knows, and what Gauss-Newton knows."""

    local: OutputProgress | None = None
    stuck: int = 0
    """Evaluations since something much better was found."""
    looks: int = 0
    """Times that it has looked elsewhere since then; each time it waits twice as long."""
    looking: bool = False
    """Whether it looks where it knows least, because nothing much better was found."""
    early: bool = False
    """Whether Gauss-Newton began right after the first samples. Its turn then ends with its first step if that is
    rejected."""
    due: str = ""
    """Why the process has arrived; empty if it has not."""
    alone: int = 0
    """Evaluations of the process since Gauss-Newton might last have begun."""
    alone_from: float = math.inf
    """Lowest loss before them."""
    kept: OutputProgress | None = None
    """What Gauss-Newton knows at the best point, while it works elsewhere; otherwise None."""
    tries: int = 0
    """Rounds elsewhere since the turn of the process."""
    failures: int = 0
    """Turns of Gauss-Newton in a row that have ended beside their start; after each the process works twice as long."""

    def is_rough_end(self, tolerance: float) -> bool:
        """Whether the last step of Gauss-Newton was short, promised next to nothing, and lost next to nothing.

        Gauss-Newton then fails because outputs are rough, as those of an adaptive solver, and not because they jump.
        Next to nothing is at most `_ROUGH` of the loss, and no more than two losses differ that count as one (`EQUAL`).
        """
        local, best = self.local, self.best
        if local is None or not local.failed or local.lost or not torch.equal(local.lowest.point, best.point):
            return False
        same = min(EQUAL * (float(self.pool.values.quantile(0.25)) - best.loss), _ROUGH * abs(best.loss))
        return local.sigma < tolerance and max(local.promised, float(local.values[-1]) - best.loss) <= same


class OutputProcess(FinishedProcess[OutputProcessProgress]):
    """A process of the output and Gauss-Newton in turn.

    Args:
        settings: of the search.
        elsewhere: whether Gauss-Newton begins at random points, too, once it has arrived.
    """

    progress = OutputProcessProgress
    local: OutputGaussNewton

    def __init__(self, settings: Settings, *, elsewhere: bool = True) -> None:
        super().__init__(settings)
        self._elsewhere = elsewhere
        self.local = OutputGaussNewton(replace(settings, restarts=0), self.capacity, _PATIENCE)
        self._afar = OutputGaussNewton(replace(settings, restarts=0), self.capacity)

    def taking_over(
        self, other: Progress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        """Begin with evaluations of another search; return the next points, too."""
        known = replace(self.begun(), phase="trial").taking(other)
        return self.points(self.remembered(known, evaluated), generator)

    def model_at_best(self, known: OutputProcessProgress) -> tuple[LocalModel, float] | None:
        best = known.best
        newton = next((one for one in (known.local, known.kept) if one and _knows(one, best.point)), None)
        if newton is not None:  # the process has not all of these
            known = replace(known, pool=Pool.of(newton.points, newton.values, newton.outputs, best.point))
        if not known.noisy:  # the nearest evaluations that determine a Jacobian, however the best one was found
            known = replace(known, best=replace(best, sigma=self.settings.tolerance))
        return super().model_at_best(known)

    def arrived(self, known: OutputProcessProgress, reason: str, end: Best | None = None) -> OutputProcessProgress:
        """Note it: Gauss-Newton may go on from there."""
        return replace(known, due=reason)

    def explores(self, known: OutputProcessProgress) -> bool:
        return super().explores(known) or (known.exploring > 0 and known.looking)

    def after_process(
        self, known: OutputProcessProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        """Let Gauss-Newton finish a new basin; where nothing much better comes, look elsewhere."""
        before, count = known.best.loss, len(evaluated.needed)
        known = self.take(replace(known, due="", early=False), evaluated)
        now = known.best.loss
        better = now < before - _BETTER * abs(before)
        known = replace(
            known,
            waited=0 if now < before else known.waited + count,
            stuck=0 if better else known.stuck + count,
            looks=0 if better else known.looks,
            alone=known.alone + count,
        )
        turn = bool(known.due) or known.waited >= PATIENCE * (self.settings.n + 1)
        early = known.finished is None and len(known.pool) > self.settings.n and not self.settings.noise
        if not known.noisy and not known.done:
            if (turn or early) and self.is_new(known):
                known = replace(known, finished=known.best.point, early=early)
                known, points = self._begun_newton(known, (_WORTH_EARLY if early else _WORTH) * abs(now), generator)
            elif self.tells_noise(known) and self._is_due(known):
                known, points = self._begun_newton(known, max(known.alone_from - now, 0.0) / known.alone, generator)
            elif known.due and not known.is_solved:  # its first step may have promised too little before
                begun, points = self._begun_newton(known, math.inf, generator)
                known = begun if begun.finishing else known
            if known.finishing:
                return known, points
        rounds = known.rounds
        known = self._went_on(known)
        if known.rounds > rounds or known.waited >= PATIENCE * (self.settings.n + 1):
            return self._begun_elsewhere(known, generator)
        return known, evaluated.points[:0]

    def after_local(
        self, known: OutputProcessProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        """Let Gauss-Newton go on, and return to the process where it ends."""
        assert known.local is not None
        if known.kept is not None:
            return self._after_elsewhere(known, known.kept, evaluated, generator)
        now, points = self.local.next(known.local, evaluated, generator)
        known = replace(self.told(known, now, evaluated), lost=now.lost)
        if known.early and now.rejected and not now.kept:
            return replace(known, finishing=False, waited=0, local=None), points
        if not now.done and not now.failed:
            return known, points
        best = known.best.point
        solved = best if now.done else None
        failures = 0 if self.is_new(known) else known.failures + 1
        known = replace(known, finishing=False, waited=0, finished=best, solved=solved, failures=failures)
        if not known.due and not now.done:
            return known, points
        return self._begun_elsewhere(super().arrived(known, known.due or _ARRIVAL), generator)

    def _begun_elsewhere(
        self, known: OutputProcessProgress, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        """Let Gauss-Newton begin at a random point if it has arrived at the best one, unless the process has waited."""
        nothing = known.center[None][:0]
        smooth = known.is_solved and known.is_minimum(self.settings.tolerance)
        if known.done or not smooth or not self._elsewhere:
            return known, nothing
        if known.tries >= _ELSEWHERE:
            return replace(known, tries=0, waited=0), nothing
        newton, points = self._afar.begin(self.settings.further_start(generator), 1.0, generator)
        return replace(known, kept=known.local, local=newton, finishing=True, tries=known.tries + 1), points

    def _after_elsewhere(
        self, known: OutputProcessProgress, kept: OutputProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        """Let Gauss-Newton go on elsewhere; where it ends let it begin again, or the process go on."""
        assert known.local is not None
        now, points = self._afar.next(known.local, evaluated, generator)
        known = replace(self.told(known, now, evaluated), lost=now.lost)
        best = known.best
        end = now.lowest if now.done else self._foreseen(now, points, best)
        if end is None and not now.failed:
            return known, points
        if best is now.best:
            known = replace(known, finished=best.point, solved=best.point if now.done else None)
        else:
            known = replace(known, local=kept)
        known = replace(known, kept=None, finishing=False, waited=0)
        if end is None:
            return replace(known, tries=0), points[:0]
        if known.agreed > 0 and known.arriving_here(self.settings.tolerance, end).agreed == 0:
            known = known.with_arrivals(higher=known.arrivals.higher + 1).ended_round(_ARRIVAL, self.settings.restarts)
        else:
            known = super().arrived(known, _ARRIVAL, end)
        return self._begun_elsewhere(known, generator)

    def _foreseen(self, now: OutputProgress, points: Tensor, best: Best) -> Best | None:
        """Return where a round leads, if it is at the best point or at a higher minimum; None if that is not known."""
        promise = self._afar.promise(now)
        if not len(points) or now.lowest.loss <= best.loss or promise == math.inf:
            return None
        if float((torch.cat([points[:1], now.lowest.point[None]]) - best.point).norm(dim=1).min()) < APART:
            return best
        return now.lowest if promise < _HIGHER * (now.lowest.loss - best.loss) else None

    def _is_due(self, known: OutputProcessProgress) -> bool:
        """Whether the process has worked alone for long enough, and the best point is not a minimum already."""
        return not known.is_solved and known.alone >= (PATIENCE * (self.settings.n + 1)) << known.failures

    def _begun_newton(
        self, known: OutputProcessProgress, least: float, generator: torch.Generator
    ) -> tuple[OutputProcessProgress, Tensor]:
        """Let Gauss-Newton begin at the best point, if its first step promises more than `least`."""
        n, best = self.settings.n, known.best
        known = replace(known, alone=0, alone_from=best.loss)
        if len(known.pool) <= n:
            return known, best.point[None][:0]
        before = known.local
        if before is not None and torch.equal(before.lowest.point, best.point):
            begun = before.taking(known, "evaluations", "iterations")
            begun = replace(
                begun, rejected=0, short=0, tied=0, lost=0, good=False, kept=False, failed=False, done=False
            )
        else:
            sigma = min(max(known.pool.reach(best.point), self.settings.tolerance), _WIDEST)
            begun = self.local.taking_over(known, known.pool, best, sigma)
        newton, points = self.local.plan(begun, generator)
        if known.due and len(points):
            step = points[0] - newton.lowest.point
            bent = 0.5 * newton.size * float(step @ newton.hessian @ step)
            if known.rounds >= self.settings.restarts or bent < _STRAIGHT * newton.promised:
                least = min(least, _ARRIVED * abs(best.loss))
        if len(points) and newton.promised > least:
            return replace(known, local=newton, finishing=True, waited=0), points
        return known, points[:0]

    def _went_on(self, known: OutputProcessProgress) -> OutputProcessProgress:
        """Arrive, or look elsewhere if that is due."""
        ended = known.is_solved or known.is_rough_end(self.settings.tolerance)
        if known.due or (ended and known.has_looked and known.is_minimum(self.settings.tolerance)):
            return super().arrived(known, known.due or "nothing lower was found than where Gauss-Newton has ended")
        if known.stuck == 0 or known.exploring == 0:
            known = replace(known, looking=False)
        n = self.settings.n
        if known.stuck < (_STUCK * (n + 1)) << known.looks:
            return known
        return replace(known, exploring=ROUND * n, stuck=0, looking=True, looks=known.looks + 1)


def _knows(newton: OutputProgress, x: Tensor) -> bool:
    """Whether Gauss-Newton has evaluated a point [n]."""
    return bool((newton.points == x).all(1).any())
