"""`python -m experiments full_setting`: what tasks leave out of the source's setting, and what that saves and changes.

A rendered task has fewer pixels, samples and bounces of light than the source (preset "paper"). Both settings are
evaluated at the same points on the line from start 0 to the solution. Each loss has the reference of its own setting.
The scale of a loss does not move its minimum, so the table also has the difference of the losses after scaling.
"""

import statistics
import time
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

from experiments.arguments import OptionalTasks
from experiments.problems import catalogue
from experiments.problems.rendered import RenderedTask
from experiments.problems.task import Preset
from experiments.reports import result_files
from experiments.reports.progress import progress

POINTS = 21
"""Points on the line, both ends included."""
HEADERS = (
    *("task", "as used", "full setting", "seconds as used", "seconds in the full setting", "ratio"),
    *("difference of the loss [%]", "difference after scaling [%]"),
)


@dataclass(frozen=True)
class Saving:
    """A task as it is used against the same task in the full setting."""

    task: str
    used: str
    full: str
    seconds: float
    """Of the processor, of one evaluation, median."""
    full_seconds: float
    ratio: float
    difference: float
    """RMS difference of the losses over the largest full loss, in percent."""
    scaled_difference: float
    """The same after the loss as used is multiplied by the factor with the least difference."""


def full_setting(
    tasks: OptionalTasks = tuple(catalogue.RENDERED), /, variant: str = "auto", store: str | None = None
) -> list[Saving]:
    """Print time and loss of rendered tasks as they are used, against the full setting of the source.

    Args:
        tasks: those that Mitsuba renders.
        variant: of Mitsuba.
        store: name under which the table is kept.
    """
    names = catalogue.chosen("tasks", tasks, list(catalogue.RENDERED))
    catalogue.check_variant(variant, names)
    result_files.may_keep(store)
    torch.set_num_threads(1)
    rows = [saving(_task(name, "fast", variant), _task(name, "paper", variant)) for name in progress(names, "tasks")]
    result_files.show(HEADERS, [list(astuple(row)) for row in rows], store)
    return rows


def saving(task: RenderedTask, whole: RenderedTask) -> Saving:
    """Measure a task against the whole task, which leaves out nothing; the scene of one is freed before the other's."""
    points = torch.stack([torch.lerp(task.start(0), task.solution, t) for t in torch.linspace(0, 1, POINTS).tolist()])
    seconds, used = _measured(task, points)
    full_seconds, full = _measured(whole, points)
    scaled = used * (used @ full) / (used @ used)
    differences = [100.0 * float((one - full).square().mean().sqrt() / full.max()) for one in (used, scaled)]
    settings = str(task.setting), str(whole.setting)
    return Saving(task.name.upper(), *settings, seconds, full_seconds, full_seconds / seconds, *differences)


def _measured(task: RenderedTask, points: Tensor) -> tuple[float, Tensor]:
    """Return seconds of an evaluation and the losses [P]; the first one, which loads the scene, moves no median."""
    seconds, losses = [], []
    for point in points:
        begin = time.process_time()
        losses.append(float(task.loss(point[None])[0]))
        seconds.append(time.process_time() - begin)
    task.renderer.release()
    return statistics.median(seconds), torch.tensor(losses, dtype=torch.float64)


def _task(name: str, preset: Preset, variant: str) -> RenderedTask:
    task = catalogue.load(name, preset, variant)
    assert isinstance(task, RenderedTask)
    return task
