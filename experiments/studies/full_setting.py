"""`python -m experiments full_setting`: what leaving out parts of the source's setting saves.

A rendered task leaves out what its loss does not need. The time of an evaluation and the loss are measured against the
same task in the source's full setting, on the line from the start to the best result of a folder. `report` shows both.
"""

import math
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from experiments.arguments import Folder
from experiments.ensembles.provenance import preset_and_variant, read_command
from experiments.problems import catalogue
from experiments.problems.catalogue import FITTING
from experiments.problems.task import Task
from experiments.reports.results import Run, first_run, load
from experiments.reports.savings import Saving, kept_saving

POINTS = 6
"""Points on the line from start to result, both ends included."""


def full_setting(folder: Folder, /) -> None:
    """Measure those tasks of a folder that leave out something of the source's setting; each is measured once.

    Args:
        folder: written by `run`.
    """
    settings = read_command(folder)["settings"]
    runs = load(folder).runs
    made = {name: preset_and_variant(settings.get(name, {})) for name in runs if name in FITTING}
    tasks = {name: catalogue.fitting(name, *made[name]) for name in made if made[name][0] == "fast"}
    reduced = {name: task for name, task in tasks.items() if task.renderer is not None}
    if not reduced:
        raise SystemExit(f"DIR must have a task that leaves out something of the source's, got {', '.join(runs)}")
    for name, task in reduced.items():
        whole = catalogue.fitting(name, "paper", made[name][1])
        print(f"{name}: {measured(task, whole, runs[name], folder / name)}", flush=True)


def measured(task: Task, whole: Task, methods: Mapping[str, Sequence[Run]], folder: Path) -> Saving:
    """Return the saving that is kept in a task's folder of results, measured first if there is none."""
    found = kept_saving(folder)
    if found is None:
        _, ends = first_run(task, methods)
        found = saving(task, whole, line(ends["start"], min(ends.values(), key=task.truth.image_error)))
        found.keep(folder)
    return found


def saving(task: Task, whole: Task, points: Tensor) -> Saving:
    """Measure a task against the whole task, in the source's setting, at points [P, n], one evaluation at a time.

    One is released before the other is loaded; the first evaluation of each, which loads and compiles, is not timed.
    """
    if points.ndim != 2 or points.shape[1] != task.n or not len(points):
        raise ValueError(f"points must be [P, {task.n}], got {list(points.shape)}")
    used, full = (_measured(one, points) for one in (task, whole))
    return Saving(
        statistics.median(seconds for seconds, _ in used),
        statistics.median(seconds for seconds, _ in full),
        _difference([value for _, value in used], [value for _, value in full]),
    )


def line(start: Tensor, end: Tensor) -> Tensor:
    """Points [POINTS, n] from start to end [n]."""
    return torch.stack([torch.lerp(start, end, t) for t in torch.linspace(0, 1, POINTS).tolist()])


def _measured(task: Task, points: Tensor) -> list[tuple[float, float]]:
    """Return seconds and loss of every point."""
    task.loss(points[:1])
    found = [_timed(task.loss, point[None]) for point in points]
    if task.renderer:
        task.renderer.release()
    return found


def _timed(loss: Callable[[Tensor], Tensor], x: Tensor) -> tuple[float, float]:
    begin = time.perf_counter()
    value = float(loss(x)[0])
    return time.perf_counter() - begin, value


def _difference(values: list[float], full: list[float]) -> float:
    peak = max(abs(value) for value in full)
    rms = math.sqrt(statistics.fmean((a - b) ** 2 for a, b in zip(values, full, strict=True)))
    return rms / peak if peak else float(rms > 0)
