"""Our searches for images of many parameters: Gauss-Newton steps on a sampled Jacobian, dense or sparse."""

from functools import partial
from typing import Any

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial

DENSE_FEWEST, SPARSE_FEWEST = 100, 20
"""Parameters from which on they are offered: `descent` needs no more evaluations below."""


def gauss_newton(trial: Trial, *, sparse: bool, **settings: Any) -> None:
    """Ask for points, evaluate them and tell, until the evaluations are used.

    Args:
        trial: the run.
        sparse: whether by `zh.optim.LocalGaussNewton`, or else by `zh.optim.BlockGaussNewton`.
        settings: of the search.
    """
    task = trial.task
    assert task.output is not None
    given = {"sigma": task.sigma, "restarts": task.evaluations} | settings  # the harness ends the run
    kind = zh.optim.LocalGaussNewton if sparse else zh.optim.BlockGaussNewton
    search = kind(trial.start, loss=task.output.loss, bounds=task.bounds, seed=trial.seed, **given)
    while not search.done:
        steps = search.iterations
        search.tell(trial.image(search.ask(limit=max(trial.remaining, 1))))
        if search.iterations > steps:
            trial.report(search.x, sigma=search.sigma * float(search.unit.mean()), loss=search.value)


def _applies(task: Task, *, fewest: int) -> str | None:
    if task.output is None:
        return "its black box returns the loss only"
    return None if task.n >= fewest else f"made for {fewest} parameters and more, the task has {task.n}"


METHODS = (
    Method(
        "block_gauss_newton",
        "ours for images of many parameters: Gauss-Newton on a Jacobian sampled block by block",
        with_settings(gauss_newton, sparse=False),
        partial(_applies, fewest=DENSE_FEWEST),
        uses="image",
    ),
    Method(
        "local",
        "ours for pixels of few parameters each: Gauss-Newton on a sparse Jacobian, found from samples",
        with_settings(gauss_newton, sparse=True),
        partial(_applies, fewest=SPARSE_FEWEST),
        uses="image",
    ),
)
