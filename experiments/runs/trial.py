"""One run of one method on one task: the black box it may call, what it reports, and how it ends."""

import random
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.problems.task import Renderer, Task
from experiments.runs.journal import DivergedError
from experiments.runs.recorder import Recorder
from experiments.runs.records import Files, Outcome, Record, Status, write_outcome

LEVELS = (0.9, 0.99, 0.999)
"""Reductions of an error that the tables are about; a run ends when both errors have the last one."""
LIMIT = 600.0
"""Seconds that a run may take."""
_SEEDS = 2**20
"""Between the numbers of the runs, which seed their starts, and the seeds of the methods."""


class Finished(Exception):
    """The run is over: the method need not catch it."""

    def __init__(self, reason: str, status: Status = "stopped") -> None:
        super().__init__(reason)
        self.status = status


class Trial:
    """What a method gets: a start, a counted black box, and `report` for the end of every iteration.

    A run ends when both errors are below a thousandth of those at the start (and, where the task asks for more, the
    parameter error below its `precision`), when the evaluations of the task or the
    seconds of `limit` are used up, or when the method returns. With a `folder` (of the ensemble) the run is logged and
    can be killed and started again, see `Recorder`; without one `rows` has what would have been logged.

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
    ) -> None:
        self.task, self.method, self.run, self.limit = task, method, run, limit
        self.start = task.start(run).double()
        """Start of this run [n], the same for every method."""
        self.seed = run + _SEEDS
        """For random numbers of the method."""
        self.x = self.start
        """What was reported last."""
        self.ended: Finished | None = None
        self.diverged: DivergedError | None = None
        files = Files(folder / task.name / method, run) if folder else None
        skip = task.renderer.skip if task.renderer else None
        self._recorder = Recorder(task.name, method, run, files, watch, skip)
        self._first = self._row(self.start, None, None)

    @property
    def evaluations(self) -> int:
        return self._recorder.evaluations

    @property
    def remaining(self) -> int:
        """Evaluations left."""
        return self.task.evaluations - self.evaluations

    @property
    def seconds(self) -> float:
        """Time of the run so far, without that for measuring errors and writing files."""
        return self._recorder.seconds

    @property
    def black_box_seconds(self) -> float:
        return self._recorder.black_box_seconds

    @property
    def rows(self) -> list[Record]:
        return self._recorder.rows

    def loss(self, x: Tensor) -> Tensor:
        """Return the loss [K] of points [K, n], for K evaluations."""
        return self._evaluate(self.task.loss, x)

    def image(self, x: Tensor) -> Tensor:
        """Return the images [K, *out] of points [K, n], for K evaluations."""
        if self.task.output is None:
            raise ValueError(f"the black box of {self.task.name} returns a loss only")
        return self._evaluate(self.task.output.image, x)

    def adjoint(self, x: Tensor, integrator: str, seed: int = 0) -> tuple[float, Tensor]:
        """Return loss and gradient [n] at x [n] by the renderer itself, for 2 evaluations; see `Renderer.adjoint`."""
        renderer = self.task.renderer or Renderer()
        adjoint = renderer.adjoint
        if adjoint is None or integrator not in renderer.adjoints:
            known = ", ".join(renderer.adjoints) or "none"
            raise ValueError(f"integrator must be one of {self.task.name}, {known}, got {integrator}")

        def both(points: Tensor) -> Tensor:
            value, gradient = adjoint(points[0], integrator, seed)
            return torch.cat([value.reshape(1), gradient])

        values = self._evaluate(both, x.detach().expand(2, -1))  # a render and its adjoint
        return float(values[0]), values[1:].clone()

    def report(self, x: Tensor, *, sigma: float | Tensor | None = None, loss: float | Tensor | None = None) -> None:
        """End an iteration at x [n], the point the method would return if it were stopped now.

        Raises Finished if both errors are small enough or the time is used up.
        """
        self._continue()
        if x.shape != self.start.shape:
            raise ValueError(f"report takes the point [{self.task.n}], got shape {list(x.shape)}")
        x = x.detach().double().clone()
        row = self._row(x, _number(sigma), _number(loss))
        self.x = x
        if self._solved(row):
            self._end(f"both errors reduced by {100 * LEVELS[-1]:g} %", "finished")
        self._in_time()

    def close(self, *, ended: bool) -> None:
        """Close the files of the run; its journal is deleted if it has ended."""
        self._recorder.close(ended=ended)

    def _evaluate(self, fn: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
        self._continue()
        if x.ndim != 2 or x.shape[1] != self.task.n:
            raise ValueError(f"points must have shape [K, {self.task.n}], got {list(x.shape)}")
        self._in_time()
        if len(x) > self.remaining:
            self._end("evaluations used up", "stopped")
        return self._guard(lambda: self._recorder.evaluate(fn, x.detach().double().clone()))

    def _solved(self, row: Record) -> bool:
        precision = self.task.truth.precision
        precise = precision is None or (row.parameter_error or 0.0) <= precision
        errors = (
            (row.image_error, self._first.image_error),
            (row.parameter_error, self._first.parameter_error),
        )
        # An error that is not defined for the task, as where there is no true solution, does not count.
        return precise and all(reduced(now, first, LEVELS[-1]) for now, first in errors if first is not None)

    def _row(self, x: Tensor, sigma: float | None, loss: float | None) -> Record:
        def errors() -> tuple[float, float]:
            return self.task.truth.image_error(x), self.task.truth.parameter_error(x)

        return self._guard(lambda: self._recorder.row(errors, sigma=sigma, loss=loss))

    def _guard(self, step: Callable[[], Any]) -> Any:
        """Remember that the replay went wrong: a library between here and the runner may swallow the exception."""
        try:
            return step()
        except DivergedError as error:
            self.diverged = error
            raise

    def _continue(self) -> None:
        """Raise again what has ended the run: a library may have swallowed it."""
        if self.diverged:
            raise self.diverged
        if self.ended:
            raise self.ended

    def _in_time(self) -> None:
        if self.seconds > self.limit:
            self._end(f"more than {self.limit:g} s", "time limit")

    def _end(self, reason: str, status: Status) -> None:
        self.ended = Finished(reason, status)
        raise self.ended


@dataclass(frozen=True)
class Ending:
    """How a method came to its end."""

    status: Status
    reason: str
    traceback: str | None = None


def ending(solve: Callable[[], object]) -> Ending:
    """Call a method and return how it ended; only Ctrl-C passes."""
    try:
        solve()
    except Finished as finished:
        return Ending(finished.status, str(finished))
    except (Exception, SystemExit) as error:
        first = f"{type(error).__name__}: {error}".splitlines()[0]
        return Ending("failed", first.rstrip(": "), traceback.format_exc())
    return Ending("stopped", "the method ended by itself")


def attempt(
    task: Task,
    method: str,
    run: int,
    solve: Callable[[Trial], object],
    folder: Path | None = None,
    *,
    limit: float = LIMIT,
    settings: dict[str, Any] | None = None,
    watch: Callable[[Record], None] | None = None,
) -> Outcome:
    """Run a method on a task to its end and return the outcome, written to `folder` if there is one.

    An exception of the method is an outcome too. A run whose journal does not belong to it, because the code has
    changed since it was killed, starts from the beginning.
    """
    if task.renderer:
        task.renderer.prepare()
    _seed(run + _SEEDS)
    trial = Trial(task, method, run, folder, limit=limit, watch=watch)
    try:
        end = ending(lambda: solve(trial))
    finally:
        trial.close(ended=trial.diverged is not None)
    files = Files(folder / task.name / method, run) if folder else None
    if files and trial.diverged:
        files.log.unlink()
        return attempt(task, method, run, solve, folder, limit=limit, settings=settings, watch=watch)
    if trial.ended:
        end = Ending(trial.ended.status, str(trial.ended))
    outcome = Outcome(
        task.name,
        method,
        run,
        end.status,
        end.reason,
        trial.seconds,
        trial.black_box_seconds,
        trial.evaluations,
        len(trial.rows) - 1,
        trial.x.tolist(),
        settings or {},
        end.traceback,
    )
    if files:
        write_outcome(outcome, files)
    return outcome


def _seed(seed: int) -> None:
    """Seed the global generators, for libraries that have no other way."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)


def reduced(error: float | None, first: float | None, level: float) -> bool:
    """Whether an error is at most 1 - level of the first one."""
    return error is not None and first is not None and error <= round(1 - level, 12) * first


def _number(value: float | Tensor | None) -> float | None:
    return None if value is None else float(value)
