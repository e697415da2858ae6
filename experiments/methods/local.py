"""Our search for images whose pixels depend on few parameters each, `zh.optim.LocalGaussNewton`."""

from typing import Any

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial

FEWEST = 20
"""Parameters from which on it is offered: `descent` needs no more evaluations below."""


def local(trial: Trial, **settings: Any) -> None:
    """Ask for points, evaluate them and tell, until the evaluations are used; `settings` are those of the search."""
    task = trial.task
    assert task.output is not None
    given = {"sigma": task.sigma, "restarts": task.evaluations} | settings  # the harness ends the run
    search = zh.optim.LocalGaussNewton(trial.start, loss=task.output.loss, bounds=task.bounds, seed=trial.seed, **given)
    while not search.done:
        steps = search.iterations
        search.tell(trial.image(search.ask(max(trial.remaining, 1))))
        if search.iterations > steps:
            trial.report(search.x, sigma=search.sigma * float(search.unit.mean()), loss=search.value)


def _applies(task: Task) -> str | None:
    if task.output is None:
        return "its black box returns the loss only"
    return None if task.n >= FEWEST else f"made for {FEWEST} parameters and more, the task has {task.n}"


METHODS = (
    Method(
        "local",
        "ours for pixels of few parameters each: Gauss-Newton on a sparse Jacobian, found from samples",
        with_settings(local),
        _applies,
        uses="image",
    ),
)
