"""Descent on an output that hands over to a Gaussian process of it: for 5 to 19 parameters in a finite box.

On smooth outputs Gauss-Newton soon takes over from the descent, and needs fewer evaluations than the process. Where the
descent has to follow the smoothed output, as over plateaus, the process needs a fraction of its evaluations. The
evidence is the loss: if n + 1 evaluations of a descent that follows take away less than `_GAIN` of the lowest loss, the
process begins with the evaluations of the descent. A descent that has arrived, or whose Gauss-Newton has taken away as
much, is not replaced.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search.method import Method, Settings
from torch_zerohess.search.output_descent import OutputDescent, OutputDescentProgress
from torch_zerohess.search.output_process import OutputProcess, OutputProcessProgress
from torch_zerohess.search.relay import Relay
from torch_zerohess.search.state import Evaluated, Progress

_GAIN = 0.2
"""Part of the lowest loss that n + 1 evaluations of a descent that follows must take away."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DescentThenProcessProgress(Progress):
    """The progress of the search whose turn it is; the other one is None."""

    descent: OutputDescentProgress | None
    process: OutputProcessProgress | None = None
    smooth: bool = False
    """Whether a turn of Gauss-Newton has taken away as much."""
    followed: int = 0
    """Evaluations by which the descent has followed since the loss was last looked at."""
    before: float = math.inf
    """The lowest loss then, or when the turn of Gauss-Newton began."""

    @property
    def engine(self) -> str:
        """Which search it is."""
        return "descent" if self.process is None else "gaussian_process"


class DescentThenProcess(Relay[DescentThenProcessProgress]):
    """`OutputDescent`, and `OutputProcess` where the descent follows and gains little."""

    engine = "descent or gaussian_process"
    progress = DescentThenProcessProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._descent, self._process = OutputDescent(settings), OutputProcess(settings)

    def first(self, generator: torch.Generator) -> tuple[DescentThenProcessProgress, Tensor]:
        descent, points = self._descent.first(generator)
        return DescentThenProcessProgress(best=descent.best, center=descent.center, descent=descent), points

    def next(
        self, known: DescentThenProcessProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[DescentThenProcessProgress, Tensor]:
        if known.process is not None:
            process, points = self._process.next(known.process, evaluated, generator)
            return replace(known, process=process).taking(process), points
        assert known.descent is not None
        before = known.descent.smooth
        descent, points = self._descent.next(known.descent, evaluated, generator)
        begins = (descent.smooth is None) != (before is None) or known.evaluations == 0  # the first batch is no step
        known = replace(known, descent=descent).taking(descent)
        if begins:
            return replace(known, followed=0, before=known.best.loss), points
        gained = known.best.loss <= known.before - _GAIN * abs(known.before)
        if descent.smooth is not None:
            return replace(known, smooth=known.smooth or gained), points
        known = replace(known, followed=known.followed + len(evaluated))
        if known.followed <= self.settings.n:
            return known, points
        pool = descent.descent.pool
        if gained or known.smooth or known.rounds or known.done or float(pool.values.min()) > known.best.loss:
            return replace(known, followed=0, before=known.best.loss), points
        process, points = self._process.taking_over(descent, pool, generator)
        return replace(known, descent=None, process=process).taking(process), points

    def turn(self, known: DescentThenProcessProgress) -> tuple[Method[Any], Any]:
        return (self._descent, known.descent) if known.process is None else (self._process, known.process)
