"""What leaving out parts of the source's setting saves: time per evaluation, and by how much the loss differs."""

import json
import math
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from experiments.problems.task import Task
from experiments.runs.records import write

POINTS = 6
"""Of the line from start to solution, both ends included."""
NAME = "saving.json"


@dataclass(frozen=True)
class Saving:
    """A task as it is used against the same task in the source's full setting."""

    seconds: float
    """Per evaluation, median."""
    full_seconds: float
    difference: float
    """RMS difference of the losses at the same points, each against its own reference, over the largest full loss."""

    @property
    def ratio(self) -> float:
        return self.full_seconds / self.seconds

    def __str__(self) -> str:
        return (
            f"time saved: {_number(self.ratio, 2)}x ({_time(self.seconds)} against {_time(self.full_seconds)} per "
            f"evaluation), loss differs by {_number(100 * self.difference, 2)} % of its peak"
        )


def saving(task: Task, points: Tensor) -> Saving:
    """Measure a task against its full setting at points [P, n], one evaluation at a time.

    One is released before the other is loaded; the first evaluation of each, which loads and compiles, is not timed.
    Raises ValueError if the task has no other setting.
    """
    if task.renderer is None or task.renderer.full is None:
        raise ValueError(f"task must have a full setting to be measured against, {task.name} has none")
    if points.ndim != 2 or points.shape[1] != task.n or not len(points):
        raise ValueError(f"points must be [P, {task.n}], got {list(points.shape)}")
    used, whole = (_measured(one, points) for one in (task, task.renderer.full()))
    return Saving(
        statistics.median(seconds for seconds, _ in used),
        statistics.median(seconds for seconds, _ in whole),
        _difference([value for _, value in used], [value for _, value in whole]),
    )


def known_saving(task: Task, points: Tensor, folder: Path) -> Saving | None:
    """Return the saving of a task, measured once and kept in a folder; None if it has no other setting."""
    if task.renderer is None or task.renderer.full is None:
        return None
    path = folder / NAME
    if path.exists():
        return Saving(**json.loads(path.read_text()))
    found = saving(task, points)
    write(path, json.dumps(asdict(found), indent=1))
    return found


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


def _time(seconds: float) -> str:
    for unit, scale in (("s", 1.0), ("ms", 1e-3)):
        if seconds >= scale:
            return f"{_number(seconds / scale, 2)} {unit}"
    return f"{_number(1e6 * seconds, 2)} us"


def _number(value: float, digits: int) -> str:
    """To some digits, but without an exponent where none is needed."""
    return f"{float(f'{value:.{digits}g}'):g}"
