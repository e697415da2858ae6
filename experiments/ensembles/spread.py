"""The black box of a task in worker processes: a run with them has the rows of a run without."""

from dataclasses import replace

import torch
from torch import Tensor

from experiments.problems import catalogue
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset, Task
from torch_zerohess.evaluators import Factory, ProcessPool


class BlackBoxOf:
    """The black box of a task, made in a worker.

    Args:
        task: by name, or an object that can be pickled.
        preset: of the task.
        variant: of Mitsuba.
        threads: of a network task, in each worker; one if None.
    """

    def __init__(self, task: str | Task | NetworkTask, preset: Preset, variant: str, threads: int | None) -> None:
        self._task = catalogue.load(task, preset, variant, threads or 1) if isinstance(task, str) else task

    def __call__(self, x: Tensor, with_loss: Tensor | None = None) -> Tensor:
        """Return images [K, *out] of points [K, n], or losses [K].

        with_loss: [K], the same for all points: whether losses are wanted.

        The points of a network task are in units of the scene.
        """
        task = self._task
        if isinstance(task, NetworkTask):
            return task.scene(x)
        if task.output is None or (with_loss is not None and bool(with_loss[0])):
            return task.loss(x)
        return task.output.image(x)


def spread(task: Task | NetworkTask, pool: ProcessPool, fn: Factory) -> Task | NetworkTask:
    """Return a task whose black box is the one in the workers; they have made it already.

    Errors of points, which are not evaluations, are still measured in this process.

    Args:
        task: whose black box it is.
        pool: of the workers, which keep what they have made for one `fn`.
        fn: makes a `BlackBoxOf` the task.
    """
    if isinstance(task, NetworkTask):
        vars(task)["scene"] = lambda x: pool(fn, x)  # in place of what it would load; it renders the first images
        return task

    def loss(x: Tensor) -> Tensor:
        return pool(fn, x, torch.ones(len(x), dtype=torch.bool))

    def image(x: Tensor) -> Tensor:
        return pool(fn, x, torch.zeros(len(x), dtype=torch.bool))

    loss(task.start(0).double().expand(pool.workers, -1))
    return replace(task, loss=loss, output=task.output and replace(task.output, image=image))
