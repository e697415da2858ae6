"""The black box of one run as the harness sees it: counted, timed, journalled and logged, and replayed after a kill."""

import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from experiments.runs.journal import DivergedError, Journal
from experiments.runs.records import Files, Log, Record


class Recorder:
    """Evaluations, seconds and rows of one run of a method on a task.

    A run that was killed is replayed. The method starts again; evaluations are answered from the journal, and rows are
    taken from the log, with their times. So no black box is called twice, and both clocks go on where they were. Then
    `skip` is told how many calls and points were answered from the journal. Without `files` nothing is written.

    Seconds are of the processor, so that other programs on the machine change them little. On an idle machine they are
    wall-clock seconds, because a run has one thread. With `parallel` threads or processes seconds are of the clock on
    the wall.
    """

    def __init__(
        self,
        task: str,
        method: str,
        run: int,
        files: Files | None = None,
        watch: Callable[[Record], None] | None = None,
        skip: Callable[[int, int], None] | None = None,
        *,
        parallel: bool = False,
    ) -> None:
        self.task, self.method, self.run = task, method, run
        self.rows: list[Record] = []
        self.evaluations = 0
        self.black_box_seconds = 0.0
        self._journal = Journal(files.journal) if files else None
        self._log = Log(files.log) if files else None
        self._logged = iter(self._log.records if self._log else ())
        self._watch, self._skip = watch, skip
        self._missed = [0, 0]
        """Calls and points that were answered from the journal."""
        self._now = time.perf_counter if parallel else time.process_time
        self._clock = Clock(self._now)

    @property
    def seconds(self) -> float:
        """Time of the run; measuring errors and writing files are not counted."""
        return self._clock.seconds

    def evaluate(self, fn: Callable[..., Tensor], x: Tensor, *aux: Tensor) -> Tensor:
        """Return fn(x [K, n], *aux) without derivatives: K evaluations."""
        self._clock.start()
        entry = self._journal.replay(x) if self._journal else None
        if entry is None:
            if self._skip and any(self._missed):
                self._skip(*self._missed)
                self._missed = [0, 0]
            began = self._now()
            with torch.no_grad():
                values = fn(x, *aux)
            self.black_box_seconds += self._now() - began
            self._clock.stop()
            if self._journal:
                self._journal.append(x, values, self.seconds, self.black_box_seconds)
        else:
            values, self.black_box_seconds = entry.values, entry.black_box_seconds
            self._missed = [self._missed[0] + 1, self._missed[1] + len(x)]
            self._clock.set(max(entry.seconds, self.rows[-1].seconds if self.rows else 0.0))
        self.evaluations += len(x)
        self._clock.start()
        return values

    def row(
        self, errors: Callable[[], tuple[float, float]], *, sigma: float | None = None, loss: float | None = None
    ) -> Record:
        """End an iteration: measure image and parameter error outside of the clock and write a row."""
        self._clock.stop()
        record = next(self._logged, None)
        if record is None:
            image, parameter = errors()
            record = Record(
                self.task,
                self.method,
                self.run,
                len(self.rows),
                self.seconds,
                self.evaluations,
                _finite(sigma),
                _finite(loss),
                _finite(image),
                _finite(parameter),
            )
            if self._log:
                self._log(record)
        elif record != replace(record, iteration=len(self.rows), evaluations=self.evaluations):
            raise DivergedError(f"iteration {len(self.rows)} of the log was after {record.evaluations} evaluations")
        else:
            self._clock.set(record.seconds)
        self.rows.append(record)
        if self._watch:
            self._watch(record)
        self._clock.start()
        return record

    def close(self, *, ended: bool) -> None:
        """Close the files; the journal of a run that has ended is not needed any more."""
        self._clock.stop()
        if self._log:
            self._log.close()
        if self._journal:
            (self._journal.delete if ended else self._journal.close)()


class Clock:
    """Seconds of `now` that can be stopped and set."""

    def __init__(self, now: Callable[[], float]) -> None:
        self._now = now
        self._before, self._since = 0.0, math.nan

    @property
    def seconds(self) -> float:
        return self._before + (0.0 if math.isnan(self._since) else self._now() - self._since)

    def start(self) -> None:
        if math.isnan(self._since):
            self._since = self._now()

    def stop(self) -> None:
        self.set(self.seconds)

    def set(self, seconds: float) -> None:
        """Stop at `seconds`."""
        self._before, self._since = seconds, math.nan


def _finite(value: Any) -> float | None:
    return None if value is None or not math.isfinite(value) else float(value)
