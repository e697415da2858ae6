"""Our searches for images of many parameters: Gauss-Newton steps on a sampled Jacobian, dense or sparse."""

from functools import partial
from typing import Any

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.ours import drive
from experiments.problems.task import Task
from experiments.runs.trial import Trial

DENSE_FEWEST, SPARSE_FEWEST = 100, 20
"""Parameters from which on they are offered: `descent` needs no more evaluations below."""


def gauss_newton(trial: Trial, *, sparse: bool, **settings: Any) -> None:
    """Search by Gauss-Newton steps until the evaluations are used.

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
    drive(trial, search, trial.image)


def _applies(task: Task, *, fewest: int) -> str | None:
    if task.output is None:
        return "its black box returns the loss only"
    return None if task.n >= fewest else f"made for {fewest} parameters and more, the task has {task.n}"


METHODS = tuple(
    Method(
        name,
        f"ours for {title}",
        with_settings(gauss_newton, sparse=sparse),
        partial(_applies, fewest=SPARSE_FEWEST if sparse else DENSE_FEWEST),
        uses="image",
    )
    for name, sparse, title in (
        ("block_gauss_newton", False, "images of many parameters: Gauss-Newton on a Jacobian sampled block by block"),
        ("local", True, "pixels of few parameters each: Gauss-Newton on a sparse Jacobian, found from samples"),
    )
)
