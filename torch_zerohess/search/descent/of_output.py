"""Descent on an output: it follows the smoothed output, and goes on by Gauss-Newton where the output is smooth.

Following (`SmoothedQuadratics`) passes plateaus and small minima, but converges slowly near a minimum whose residuals
are not zero. Interpolation (`OutputGaussNewton`) converges fast on smooth outputs and stops at their kinks. The
evidence is a step that lowers the loss and whose output was predicted well. Where Gauss-Newton fails, the descent
follows again from the best point, with the sigma that it had.
"""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search.descent.progress import DescentProgress
from torch_zerohess.search.descent.smoothed import SmoothedQuadratics
from torch_zerohess.search.gauss_newton.by_interpolation import OutputGaussNewton, OutputProgress
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.relay import Relay
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated, Progress
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel

MOST = 40
"""Parameters up to which Gauss-Newton by interpolation goes on. Its first model takes n + 1 evaluations."""
_PREDICTED = 0.25
"""Misfit of a predicted output below which the output counts as smooth."""
_LEAST = 0.1
"""Least first radius of Gauss-Newton, over the distance of the nearest evaluations."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputDescentProgress(Progress):
    """The descent that follows, and Gauss-Newton while it has taken over."""

    descent: DescentProgress
    smooth: OutputProgress | None = None


class OutputDescent(Relay[OutputDescentProgress]):
    """The method of `Descent` for an output under a loss. In noise, and above 40 parameters, it only follows.

    With one or two parameters, and no noise, it begins with Gauss-Newton: a quadratic of the loss, by which the descent
    goes on there, predicts no output.
    """

    engine = "descent"
    progress = OutputDescentProgress

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self._follow = SmoothedQuadratics(settings)
        self._smooth = OutputGaussNewton(settings, self._follow.capacity)
        self._may = settings.noise == 0.0 and settings.n <= MOST

    def first(self, generator: torch.Generator) -> tuple[OutputDescentProgress, Tensor]:
        descent, points = self._follow.first(generator)
        known = OutputDescentProgress(best=descent.best, center=descent.center, descent=descent).taking(descent)
        if not self._may or self._follow.follows:
            return known, points
        smooth, points = self._smooth.first(generator)
        return replace(known, smooth=smooth), points

    def taking_over(
        self, other: Progress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputDescentProgress, Tensor]:
        """Begin with the evaluations of another search, the best one first; return the next points, too."""
        descent = self._follow.begun(Best(evaluated.points[0]))
        descent = descent.taking(other, "iterations").with_arrivals(rounds=other.rounds)
        known = OutputDescentProgress(best=descent.best, center=descent.center, descent=descent)
        return self.next(known, evaluated, generator)

    def next(
        self, known: OutputDescentProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputDescentProgress, Tensor]:
        if known.smooth is not None:
            return self._went_on(known, *self._smooth.next(known.smooth, evaluated, generator), generator)
        before = known.descent
        descent = self._follow.take(before, evaluated, generator)
        known = replace(known, descent=descent)
        if self._is_smooth(before, descent, evaluated):
            step = float((evaluated.points[0] - before.center).norm())
            reach = min(descent.pool.reach(descent.lowest.point), descent.sigma)
            smooth = self._smooth.taking_over(descent, descent.pool, descent.lowest, max(step, _LEAST * reach))
            return self._went_on(known, *self._smooth.plan(smooth, generator), generator)
        return known.taking(descent), self._follow.points(descent, generator)

    def turn(self, known: OutputDescentProgress) -> tuple[Method[Any], Any]:
        return (self._follow, known.descent) if known.smooth is None else (self._smooth, known.smooth)

    def model_at_best(self, known: OutputDescentProgress) -> tuple[LocalModel, float] | None:
        descent = known.descent if known.smooth is None else self._with_evaluations(known.descent, known.smooth)
        return self._follow.model_at_best(replace(descent, best=known.best))

    def _is_smooth(self, before: DescentProgress, descent: DescentProgress, evaluated: Evaluated) -> bool:
        """Whether the end of a step had the output that was predicted, and a lower loss."""
        step = before.phase == "trial" and bool(evaluated.finite[0]) and descent.rounds == before.rounds
        if not (step and self._may and self._follow.follows) or len(descent.pool) <= descent.n:
            return False
        assert before.model is not None
        assert evaluated.outputs is not None
        misfit = before.model.misfit(before.step, evaluated.outputs[0])
        return misfit < _PREDICTED and float(evaluated.losses[0]) < before.value

    def _went_on(
        self, known: OutputDescentProgress, smooth: OutputProgress, points: Tensor, generator: torch.Generator
    ) -> tuple[OutputDescentProgress, Tensor]:
        """Return the progress of Gauss-Newton and its points, or of the descent where Gauss-Newton is at its end."""
        if not (smooth.done or smooth.failed):
            now = replace(known, smooth=smooth).taking(smooth)
            return now.taking(known, "arrivals"), points
        descent = self._with_evaluations(known.descent, smooth)
        if smooth.done:
            descent = replace(descent, sigma=min(smooth.sigma, 0.5 * self.settings.tolerance))
            descent = self._follow.arrive(descent, smooth.message, generator)
        else:
            descent = replace(descent, center=smooth.lowest.point, value=smooth.lowest.loss, faithful=False)
            descent = descent.sampling(2)
        return replace(known, descent=descent, smooth=None).taking(descent), self._follow.points(descent, generator)

    def _with_evaluations(self, descent: DescentProgress, smooth: OutputProgress) -> DescentProgress:
        """Return the descent with the evaluations of Gauss-Newton."""
        outputs = smooth.outputs if len(smooth.points) else None
        pool = Pool.of(smooth.points, smooth.values, outputs, smooth.lowest.point)
        return replace(descent, pool=pool).taking(smooth, "best", "lowest", "evaluations", "iterations", "shape")
