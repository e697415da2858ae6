"""Our search for images of many parameters, `zh.optim.BlockGaussNewton`."""

from typing import Any

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial

FEWEST = 100
"""Parameters from which on it is offered: `descent` needs fewer evaluations below."""


def block_gauss_newton(trial: Trial, **settings: Any) -> None:
    """Ask for points, evaluate them and tell, until the evaluations are used; `settings` are those of the search."""
    task = trial.task
    assert task.output is not None
    given = {"sigma": task.sigma, "restarts": task.evaluations} | settings  # the harness ends the run
    search = zh.optim.BlockGaussNewton(trial.start, loss=task.output.loss, bounds=task.bounds, seed=trial.seed, **given)
    while not search.done:
        steps = search.iterations
        search.tell(trial.image(search.ask(max(trial.remaining, 1))))
        if search.iterations > steps:
            trial.report(search.x, sigma=search.sigma * float(search.unit.mean()), loss=search.value)


def _applies(task: Task) -> str | None:
    if task.output is None:
        return "its black box returns the loss only"
    return None if task.n >= FEWEST else f"made for {FEWEST} parameters and more, where descent has few samples"


METHODS = (
    Method(
        "block_gauss_newton",
        "ours for images of many parameters: Gauss-Newton on a Jacobian sampled block by block",
        with_settings(block_gauss_newton),
        _applies,
        uses="image",
    ),
)
