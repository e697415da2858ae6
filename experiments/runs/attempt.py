"""A run from its preparation to its outcome, for both kinds of task."""

import io
import math
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Task
from experiments.runs.base_trial import SEEDS, Ending, ending
from experiments.runs.network_trial import NetworkTrial
from experiments.runs.records import Outcome, Preparation, Record, write, write_outcome
from experiments.runs.trial import LIMIT, Trial


def attempt(
    task: Task | NetworkTask,
    method: str,
    run: int,
    solve: Callable[[Any], object],
    folder: Path | None = None,
    *,
    limit: float | None = None,
    settings: dict[str, Any] | None = None,
    watch: Callable[[Record], None] | None = None,
    preparing: Callable[[Preparation], None] | None = None,
    parallel: bool = False,
) -> Outcome:
    """Run a method on a task to its end and return the outcome, written to `folder` if there is one.

    An exception of the method is an outcome too. A run whose journal does not belong to it, because the code has
    changed since it was killed, starts from the beginning. The weights of a network are written beside the outcome.

    Args:
        task: of either kind.
        method: its name, for the log.
        run: number of the run.
        solve: gets a `Trial`, or of a network task a `NetworkTrial`.
        folder: of the ensemble.
        limit: seconds that the run may take; if None `LIMIT`, and for a network task any.
        settings: written to the outcome.
        watch: gets every row.
        preparing: gets the progress before the run, outside of its clock.
        parallel: whether the black box runs in other processes; then seconds are of the clock on the wall.
    """
    _prepare(task, method, run, preparing)
    _seed(run + SEEDS)
    trial = _trial(task, method, run, folder, limit, watch, parallel)
    try:
        end = ending(lambda: solve(trial))
    finally:
        trial.close(ended=trial.diverged is not None)
    if trial.files and trial.diverged:
        trial.files.log.unlink()
        again: dict[str, Any] = {"settings": settings, "watch": watch, "preparing": preparing, "parallel": parallel}
        return attempt(task, method, run, solve, folder, limit=limit, **again)
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
        trial.x.tolist() if isinstance(trial, Trial) else [],
        settings or {},
        end.traceback,
    )
    if trial.files:
        if isinstance(trial, NetworkTrial) and end.status != "failed":
            weights = io.BytesIO()
            torch.save(trial.encoder.state_dict(), weights)
            write(trial.files.weights, weights.getvalue())
        write_outcome(outcome, trial.files)
    return outcome


def _prepare(task: Task | NetworkTask, method: str, run: int, preparing: Callable[[Preparation], None] | None) -> None:
    """Load and render what a run needs before its clock starts."""
    if isinstance(task, NetworkTask):

        def progress(done: int, total: int) -> None:
            if preparing:
                preparing(Preparation(task.name, method, run, done, total))

        task.prepare(run, progress)
    elif task.renderer:
        task.renderer.prepare()


def _trial(
    task: Task | NetworkTask,
    method: str,
    run: int,
    folder: Path | None,
    limit: float | None,
    watch: Callable[[Record], None] | None,
    parallel: bool,
) -> Trial | NetworkTrial:
    if isinstance(task, NetworkTask):
        most = math.inf if limit is None else limit
        return NetworkTrial(task, method, run, folder, limit=most, watch=watch, parallel=parallel)
    return Trial(task, method, run, folder, limit=LIMIT if limit is None else limit, watch=watch, parallel=parallel)


def _seed(seed: int) -> None:
    """Seed the global generators, for libraries that have no other way."""
    random.seed(seed)
    np.random.seed(seed)
    torch.manual_seed(seed)
