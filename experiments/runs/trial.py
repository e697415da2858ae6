"""One run of one method on one fitting task: the black box it may call, what it reports, and when it is solved."""

from collections.abc import Callable
from pathlib import Path

import torch
from torch import Tensor

from experiments.problems.task import Renderer, Task
from experiments.runs.base_trial import BaseTrial, number
from experiments.runs.records import Record

LEVELS = (0.9, 0.99, 0.999)
"""Reductions of an error that the tables are about; a run ends when both errors have the last one."""
LIMIT = 600.0
"""Seconds that a run may take."""


class Trial(BaseTrial):
    """What a method gets: a start, a counted black box, and `report` for the end of every iteration.

    A run ends when both errors are below a thousandth of those at the start (and, where the task asks for more, the
    parameter error below its `precision`), when the evaluations of the task or the seconds of `limit` are used up, or
    when the method returns. See `BaseTrial` for `folder`.

    Example:
        >>> from experiments.problems.tasks import quad
        >>> trial = Trial(quad.task(), "steepest descent", run=0)
        >>> trial.loss(trial.start[None]).shape, trial.evaluations
        (torch.Size([1]), 1)
        >>> trial.report(0.5 * trial.start)
        >>> [row.iteration for row in trial.rows]
        [0, 1]
    """

    def __init__(
        self,
        task: Task,
        method: str,
        run: int,
        folder: Path | None = None,
        *,
        limit: float = LIMIT,
        watch: Callable[[Record], None] | None = None,
        parallel: bool = False,
    ) -> None:
        skip = task.renderer.skip if task.renderer else None
        super().__init__(task.name, method, run, task.evaluations, folder, limit, watch, skip, parallel=parallel)
        self.task = task
        self.start = task.start(run).double()
        """Start of this run [n], the same for every method."""
        self.x = self.start
        """What was reported last."""
        self._first = self._measured(self.start, None, None)

    def loss(self, x: Tensor) -> Tensor:
        """Return the loss [K] of points [K, n], for K evaluations."""
        return self._called(self.task.loss, x)

    def image(self, x: Tensor) -> Tensor:
        """Return the images [K, *out] of points [K, n], for K evaluations."""
        if self.task.output is None:
            raise ValueError(f"the black box of {self.task.name} returns a loss only")
        return self._called(self.task.output.image, x)

    def adjoint(self, x: Tensor, integrator: str, seed: int = 0) -> tuple[float, Tensor]:
        """Return loss and gradient [n] at x [n] by the renderer itself, for 2 evaluations; see `Renderer.adjoint`."""
        renderer = self.task.renderer or Renderer()
        adjoint = renderer.adjoint
        if adjoint is None or integrator not in renderer.adjoints:
            known = ", ".join(renderer.adjoints) or "none"
            raise ValueError(f"integrator must be one that {self.task.name} has ({known}), got {integrator}")

        def both(points: Tensor) -> Tensor:
            value, gradient = adjoint(points[0], integrator, seed)
            return torch.cat([value.reshape(1), gradient])

        values = self._called(both, x.detach().expand(2, -1))  # a render and its adjoint
        return float(values[0]), values[1:].clone()

    def report(self, x: Tensor, *, sigma: float | Tensor | None = None, loss: float | Tensor | None = None) -> None:
        """End an iteration at x [n], the point the method would return if it were stopped now.

        Raises Finished if both errors are small enough or the time is used up.
        """
        self._continue()
        if x.shape != self.start.shape:
            raise ValueError(f"report takes the point [{self.task.n}], got shape {list(x.shape)}")
        x = x.detach().double().clone()
        row = self._measured(x, number(sigma), number(loss))
        self.x = x
        if self._solved(row):
            self._end(f"both errors reduced by {100 * LEVELS[-1]:g} %", "finished")
        self._in_time()

    def _called(self, fn: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
        if x.ndim != 2 or x.shape[1] != self.task.n:
            raise ValueError(f"points must have shape [K, {self.task.n}], got {list(x.shape)}")
        return self._evaluate(fn, x.detach().double().clone())

    def _measured(self, x: Tensor, sigma: float | None, loss: float | None) -> Record:
        """Write a row with the errors of x [n]."""
        truth = self.task.truth
        return self._row(lambda: (truth.image_error(x), truth.parameter_error(x)), sigma, loss)

    def _solved(self, row: Record) -> bool:
        precision = self.task.truth.precision
        precise = precision is None or (row.parameter_error or 0.0) <= precision
        errors = (
            (row.image_error, self._first.image_error),
            (row.parameter_error, self._first.parameter_error),
        )
        # An error that is not defined for the task, as where there is no true solution, does not count.
        return precise and all(reduced(now, first, LEVELS[-1]) for now, first in errors if first is not None)


def reduced(error: float | None, first: float | None, level: float) -> bool:
    """Whether an error is at most 1 - level of the first one."""
    return error is not None and first is not None and error <= round(1 - level, 12) * first
