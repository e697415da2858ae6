"""Descent on an output and a Gaussian process of it, in turn: for 5 to 19 parameters in a finite box.

On smooth outputs Gauss-Newton soon takes over from the descent, and needs fewer evaluations than the process. Where the
descent has to follow the smoothed output, as over plateaus, the process often needs a fraction of its evaluations, and
sometimes finds nothing. The evidence is the loss. The descent begins. If n + 1 evaluations of a descent that follows
take away less than `_SLOW` of the lowest loss, the process goes on, with the evaluations of the descent. If
`_PATIENCE` (n + 1) evaluations of the process take away less than `_STUCK` of it, the descent goes on: from where it
was, or from the best point if that is much better. The next turn of the process comes when the descent arrives.

A descent whose Gauss-Newton arrives, or takes away as much as `_SLOW`, may be slow later: the process has its turn only
if the descent arrives elsewhere than at the lowest minimum.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search.descent.of_output import OutputDescent, OutputDescentProgress
from torch_zerohess.search.gaussian_process.of_output import OutputProcess, OutputProcessProgress
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.relay import Relay
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated, Progress

_SLOW = 0.2
"""Part of the lowest loss that n + 1 evaluations of a descent that follows must take away."""
_STUCK, _PATIENCE = 0.1, 8
"""Part of the lowest loss that evaluations of the process must take away, and their number over n + 1."""
_SHARED = "best", "evaluations", "iterations", "arrivals"
"""What the descent learns about a turn of the process."""


@dataclass(frozen=True, eq=False, kw_only=True)
class TurnsProgress(Progress):
    """The progress of both searches."""

    descent: OutputDescentProgress
    process: OutputProcessProgress | None = None
    """None if it is not its turn."""
    planned: Tensor
    """Points [r, n] that the descent asks for next, when its turn comes again."""
    record: Best
    """The point with the lowest loss that was evaluated: in noise the process predicts the loss of its best point."""
    output: Tensor
    """At `record` [m]."""
    smooth: bool = False
    """Whether Gauss-Newton has arrived or taken away as much as `_SLOW`: a descent that follows may then be slow."""
    resumed: bool = False
    """Whether the process has had a turn."""
    counted: int = 0
    """Evaluations by which the search whose turn it is has followed, or looked, since the loss was last looked at."""
    before: float = math.inf
    """The lowest loss then, or when the turn of Gauss-Newton began."""

    def gained(self, part: float, lowest: float) -> bool:
        """Whether the lowest loss has fallen by this part."""
        return lowest < self.before - part * abs(self.before)

    @property
    def engine(self) -> str:
        """Whose turn it is."""
        return "descent" if self.process is None else "gaussian_process"


class DescentAndProcess(Relay[TurnsProgress]):
    """`OutputDescent` and `OutputProcess` in turn, within finite bounds."""

    engine = "descent and gaussian_process"
    progress = TurnsProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._descent, self._process = OutputDescent(settings), OutputProcess(settings, elsewhere=False)

    def first(self, generator: torch.Generator) -> tuple[TurnsProgress, Tensor]:
        descent, points = self._descent.first(generator)
        best, none = descent.best, points[:0]
        known = TurnsProgress(
            best=best, center=descent.center, descent=descent, planned=none, record=best, output=none.flatten()
        )
        return known, points

    def next(
        self, known: TurnsProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[TurnsProgress, Tensor]:
        new = evaluated.sound
        record = known.record.or_lower(new, known.sigma)
        if record is not known.record:
            assert new.outputs is not None
            known = replace(known, record=record, output=new.outputs[int(new.losses.argmin())])
        step = self._by_descent if known.process is None else self._by_process
        return step(known, evaluated, generator)

    def turn(self, known: TurnsProgress) -> tuple[Method[Any], Any]:
        return (self._descent, known.descent) if known.process is None else (self._process, known.process)

    def _by_descent(
        self, known: TurnsProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[TurnsProgress, Tensor]:
        """Let the descent go on, and the process begin where the descent is slow, or arrives at another minimum."""
        before, rounds, first = known.descent.smooth, known.rounds, known.evaluations == 0
        descent, points = self._descent.next(known.descent, evaluated, generator)
        known = replace(known, descent=descent).taking(descent)
        gained = known.gained(_SLOW, known.best.loss)
        if known.rounds > rounds and not known.done and (known.resumed or known.agreed == 0):
            return self._to_process(known, points, generator)
        if before is not None and (gained or known.rounds > rounds):
            known = replace(known, smooth=True)
        if first or (descent.smooth is None) != (before is None):  # the first batch is no step
            return replace(known, counted=0, before=known.best.loss), points
        known = replace(known, counted=known.counted + len(evaluated))
        if known.counted <= self.settings.n or descent.smooth is not None:
            return known, points
        if gained or known.smooth or known.resumed or known.done:
            return replace(known, counted=0, before=known.best.loss), points
        return self._to_process(known, points, generator)

    def _by_process(
        self, known: TurnsProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[TurnsProgress, Tensor]:
        """Let the process go on, and the descent where the process is stuck."""
        assert known.process is not None
        process, points = self._process.next(known.process, evaluated, generator)
        known = replace(known, process=process, counted=known.counted + len(evaluated)).taking(process)
        if known.gained(_STUCK, known.record.loss):
            return replace(known, counted=0, before=known.record.loss), points
        if known.counted <= _PATIENCE * (self.settings.n + 1) or process.finishing or known.done:
            return known, points
        return self._to_descent(known, process, generator)

    def _to_process(
        self, known: TurnsProgress, points: Tensor, generator: torch.Generator
    ) -> tuple[TurnsProgress, Tensor]:
        """Let the process begin with what the descent knows, and with the lowest point."""
        pool, best = known.descent.descent.pool, known.record
        assert pool.outputs is not None
        given = Evaluated(
            torch.cat([pool.points, best.point[None]]),
            torch.cat([pool.values, pool.values.new_tensor([best.loss])]),
            torch.cat([pool.outputs, known.output[None]]),
            known.shape,
        )
        apart = (pool.points - best.point).norm(dim=1) > 0.0
        given = given.those(torch.cat([apart, apart.new_ones(1)]))
        process, asked = self._process.taking_over(known, given, generator)
        known = replace(known, process=process, planned=points, counted=0, before=best.loss)
        return known.taking(process), asked

    def _to_descent(
        self, known: TurnsProgress, process: OutputProcessProgress, generator: torch.Generator
    ) -> tuple[TurnsProgress, Tensor]:
        """Let the descent go on where it was; or at the best point, with what the process knows, if that is better."""
        known = replace(known, best=known.record)
        descent, points, pool = known.descent, known.planned, process.pool
        if known.best.loss < descent.best.loss - _STUCK * abs(descent.best.loss):
            given = Evaluated(pool.points, pool.values, pool.outputs, known.shape)
            given = given.those(pool.values.argsort(stable=True))
            descent, points = self._descent.taking_over(known, given, generator)
        inner = descent.descent.taking(known, *_SHARED)
        descent = replace(descent, descent=inner).taking(known, *_SHARED)
        known = replace(known, descent=descent, process=None, counted=0, before=known.best.loss, resumed=True)
        return known.taking(descent), points
