"""Our searches, with their default settings on every task but for sigma and bounds.

| method | engine of `zh.optim.TrustRegion` | from |
|---|---|---|
| auto | the choice of the package | image and white-box loss, or the loss alone where there is no image |
| gaussian_process | a Gaussian process in a box | image and white-box loss |
| gaussian_process_loss | the same | loss alone |
| descent | local quadratic models | image and white-box loss, or the loss alone where there is no image |
| descent_loss | the same | loss alone |
"""

from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial

MOST = 10
"""Parameters up to which a Gaussian process is offered."""


def search(
    trial: Trial,
    *,
    engine: Literal["auto", "gaussian_process", "descent"] = "auto",
    sigma: float | None = None,
    output: bool = True,
) -> None:
    """Search by `zh.optim.TrustRegion` until the evaluations are used.

    Args:
        trial: the run.
        engine: of `zh.optim.TrustRegion`.
        sigma: at the start, in units of the parameters; `Task.sigma` if None.
        output: whether to use the image and the white-box loss where the task has them, not the loss alone.
    """
    task = trial.task
    loss = task.output.loss if task.output and output else None
    evaluate = trial.image if loss else trial.loss
    found = zh.optim.TrustRegion(
        trial.start,
        sigma=sigma or task.sigma,
        bounds=task.bounds,
        loss=loss,
        engine=engine,
        restarts=task.evaluations,  # the harness ends the run
        seed=trial.seed,
    )
    drive(trial, found, evaluate)


def drive(trial: Trial, search: Any, evaluate: Callable[[Tensor], Tensor]) -> None:
    """Ask a search for points, evaluate them, tell it and report, until it or the run is done.

    Args:
        trial: the run.
        search: of `zh.optim`.
        evaluate: points [K, n] to values [K], or outputs [K, *out].
    """
    while not search.done:
        search.tell(evaluate(search.ask(limit=max(trial.remaining, 1))))
        trial.report(search.x, sigma=float((search.sigma * search.unit).mean()), loss=search.value)


def _has_output(task: Task) -> str | None:
    return None if task.output else "its black box returns the loss only, which the method without _loss uses"


def _in_box(task: Task) -> str | None:
    """Say why a Gaussian process cannot search everywhere."""
    if task.bounds is None or not bool(torch.isfinite(torch.stack(task.bounds)).all()):
        return "searches within finite bounds, the task has none"
    return None if task.n <= MOST else f"a Gaussian process for up to {MOST} parameters, the task has {task.n}"


METHODS = (
    Method(
        "auto",
        "ours: the engine that the package chooses, as `zh.minimize` does",
        with_settings(search, engine="auto"),
        uses="image",
    ),
    Method(
        "gaussian_process",
        "ours: a Gaussian process of the image, under the known loss",
        with_settings(search, engine="gaussian_process"),
        _in_box,
        uses="image",
    ),
    Method(
        "descent",
        "ours: quadratic models of the image, re-using evaluations",
        with_settings(search, engine="descent"),
        uses="image",
    ),
    Method(
        "gaussian_process_loss",
        "gaussian_process from the loss alone",
        with_settings(search, engine="gaussian_process", output=False),
        lambda task: _in_box(task) or _has_output(task),
    ),
    Method(
        "descent_loss",
        "descent from the loss alone",
        with_settings(search, engine="descent", output=False),
        _has_output,
    ),
)
