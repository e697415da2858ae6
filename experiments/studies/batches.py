"""`python -m experiments batches`: what it saves to evaluate several points at once.

`zh.minimize(engine="gaussian_process")` searches from the same starts with batches of several sizes, in this process
and in worker processes. As many workers as a batch has points evaluate it in one round; one worker evaluates one point
in a round. Rounds and evaluations are counted until the loss is reduced by 99 %. Then the search evaluates x once more,
to see whether it was noise that reached the target; seconds include this. The ratios are to batches of one point in
this process: rounds tell what as many workers as points would gain, seconds what the workers of this machine gain. Runs
of one start take turns, so that whatever else the machine does falls on all of them alike.
"""

import math
import statistics
import time
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import astuple, dataclass
from typing import Literal

import torch

import torch_zerohess as zh
from experiments.arguments import OptionalTasks
from experiments.methods import METHODS
from experiments.methods.settings import settings
from experiments.problems import catalogue
from experiments.problems.task import Task
from experiments.reports import result_files
from experiments.reports.progress import progress
from experiments.studies.workers import images_of
from torch_zerohess.evaluators import Factory, Inline, ProcessPool

METHOD: Literal["gaussian_process"] = "gaussian_process"
TASKS = ("mug", "shad", "bunny", "mirror", "box2", "brdf")
_WARM = 8
"""Points of a call that gives each worker some."""
REDUCED = 0.99
"""Share of the first loss that is to be taken away."""
HEADERS = [
    *("task", "batch", "workers", "runs", "reached", "rounds", "evaluations", "seconds"),
    *("rounds / one by one", "seconds / one by one"),
]


@dataclass(frozen=True)
class Search:
    """One search until the target."""

    reached: bool
    rounds: int
    """Until the target, by as many workers as a batch has points."""
    evaluations: int
    """Until the target."""
    seconds: float
    """Until the end of the search."""


@dataclass(frozen=True)
class Row:
    """Medians over starts; the ratios are medians of the ratios of single starts."""

    task: str
    batch: int
    workers: int
    """Processes that evaluate; 0: this process."""
    runs: int
    reached: float
    """Share of the starts that get there."""
    rounds: float
    evaluations: float
    seconds: float
    rounds_ratio: float
    seconds_ratio: float


def batches(
    tasks: OptionalTasks = TASKS,
    /,
    sizes: tuple[int, ...] = (1, 4, 16),
    workers: int = 2,
    runs: int = 6,
    seed: int = 0,
    evaluations: int = 400,
    store: str | None = None,
) -> list[Row]:
    """Measure rounds, evaluations and seconds of searches by the size of their batches.

    Args:
        tasks: fitting tasks.
        sizes: of a batch, in points, 1 first.
        workers: processes that evaluate batches of more than one point, besides this process; 0: none.
        runs: starts.
        seed: number of the first start.
        evaluations: of a search, at most.
        store: name under which the table is kept.
    """
    if not sizes or sizes[0] != 1 or min(sizes) < 1 or runs < 1 or workers < 0:
        raise SystemExit(f"sizes must begin with 1, and runs be at least 1, got {sizes}, {runs} and {workers} workers")
    names = catalogue.chosen("tasks", tasks, list(catalogue.FITTING))
    for name in names:
        task = catalogue.fitting(name)
        if reason := METHODS[METHOD].unusable(task) or (None if task.output else "its black box returns the loss only"):
            raise SystemExit(f"tasks must be such that {METHOD} searches them by their images, got {name}: {reason}")
    result_files.may_keep(store)
    torch.set_num_threads(1)
    ways = [(size, count) for size in sizes for count in ((0,) if size == 1 or not workers else (0, workers))]
    rows = []
    for name in progress(names, "tasks"):
        task, spread = catalogue.fitting(name), Factory(images_of, name)
        with ProcessPool(workers) if workers else nullcontext() as pool:  # of one task: workers keep their scenes
            found = [
                [_search(task, spread, run, batch, pool if count else None, evaluations) for batch, count in ways]
                for run in range(seed, seed + runs)
            ]
        rows += _rows(name, ways, found)
        if task.renderer is not None:  # two loaded scenes slow each other down
            task.renderer.release()
    result_files.show(HEADERS, [list(astuple(row)) for row in rows], store)
    return rows


def _search(task: Task, spread: Factory, run: int, batch: int, pool: ProcessPool | None, most: int) -> Search:
    """Search from one start, in this process without a pool."""
    assert task.output is not None
    start, evaluator = task.start(run), pool or Inline()
    fn = task.output.image if pool is None else spread
    first = evaluator(fn, start.expand(_WARM, -1))[0]  # before the clock starts, every process has loaded its scene
    target = (1.0 - REDUCED) * float(task.output.loss(first))
    rounds, evaluations, reached = 0, 0, False

    def count(now: zh.Iterate) -> None:
        nonlocal rounds, evaluations, reached
        if not reached:
            rounds += math.ceil((now.evaluations - evaluations) / batch)
            evaluations, reached = now.evaluations, now.value <= target

    began = time.perf_counter()
    zh.minimize(
        fn,
        start,
        **{"sigma": task.sigma} | settings(METHOD, task.name),
        loss=task.output.loss,
        bounds=task.bounds,
        engine=METHOD,
        target=target,
        max_evaluations=most,
        batch=batch,
        evaluator=evaluator,
        callback=count,
        seed=0,
    )
    return Search(reached, rounds, evaluations, time.perf_counter() - began)


def _rows(name: str, ways: Sequence[tuple[int, int]], found: Sequence[Sequence[Search]]) -> list[Row]:
    """Return a row for each way, from the searches of each start."""
    rows = []
    for (batch, workers), searches in zip(ways, zip(*found, strict=True), strict=True):
        alone = [of_start[0] for of_start in found]
        rows.append(
            Row(
                *(name, batch, workers, len(searches)),
                statistics.mean(one.reached for one in searches),
                statistics.median(one.rounds for one in searches),
                statistics.median(one.evaluations for one in searches),
                statistics.median(one.seconds for one in searches),
                statistics.median(one.rounds / first.rounds for one, first in zip(searches, alone, strict=True)),
                statistics.median(one.seconds / first.seconds for one, first in zip(searches, alone, strict=True)),
            )
        )
    return rows
