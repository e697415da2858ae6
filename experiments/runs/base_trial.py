"""What every run has in common: a counted black box, rows, an end, and a replay after a kill.

`Trial` is the run of a fitting task, `NetworkTrial` the run of a network task.
"""

import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from torch import Tensor

from experiments.runs.journal import DivergedError
from experiments.runs.recorder import Recorder
from experiments.runs.records import Files, Record, Status

T = TypeVar("T")
SEEDS = 2**20
"""Between the numbers of the runs, which seed their starts, and the seeds of the methods."""


class Finished(Exception):
    """The run is over: the method need not catch it."""

    def __init__(self, reason: str, status: Status = "stopped") -> None:
        super().__init__(reason)
        self.status = status


class BaseTrial:
    """A run that may use so many evaluations and seconds. What ends it is raised again at every later call.

    With a `folder` (of the ensemble) the run is logged and can be killed and started again, see `Recorder`; without one
    `rows` has what would have been logged.
    """

    def __init__(
        self,
        task: str,
        method: str,
        run: int,
        evaluations: int,
        folder: Path | None,
        limit: float,
        watch: Callable[[Record], None] | None,
        skip: Callable[[int, int], None] | None = None,
        *,
        parallel: bool = False,
    ) -> None:
        self.method, self.run, self.limit = method, run, limit
        self.seed = run + SEEDS
        """For random numbers of the method."""
        self.ended: Finished | None = None
        self.diverged: DivergedError | None = None
        self.files = Files(folder / task / method, run) if folder else None
        self._budget = evaluations
        self._recorder = Recorder(task, method, run, self.files, watch, skip, parallel=parallel)

    @property
    def evaluations(self) -> int:
        """Evaluations used."""
        return self._recorder.evaluations

    @property
    def remaining(self) -> int:
        """Evaluations left."""
        return self._budget - self.evaluations

    @property
    def seconds(self) -> float:
        """Time of the run so far, without that for measuring errors and writing files."""
        return self._recorder.seconds

    @property
    def black_box_seconds(self) -> float:
        """Time that the black box has taken."""
        return self._recorder.black_box_seconds

    @property
    def rows(self) -> list[Record]:
        """What was logged."""
        return self._recorder.rows

    def close(self, *, ended: bool) -> None:
        """Close the files of the run; its journal is deleted if it has ended."""
        self._recorder.close(ended=ended)

    def _evaluate(self, fn: Callable[..., Tensor], x: Tensor, *aux: Tensor) -> Tensor:
        self._continue()
        self._in_time()
        if len(x) > self.remaining:
            self._end("evaluations used up", "stopped")
        return self._guard(lambda: self._recorder.evaluate(fn, x, *aux))

    def _row(self, errors: Callable[[], tuple[float, float]], sigma: float | None, loss: float | None) -> Record:
        return self._guard(lambda: self._recorder.row(errors, sigma=sigma, loss=loss))

    def _guard(self, step: Callable[[], T]) -> T:
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


def number(value: float | Tensor | None) -> float | None:
    """Return a number that a method reports as a float."""
    return None if value is None else float(value)
