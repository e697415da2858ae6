"""The recommended method: `zh.optim.TrustRegion`, with its default settings on every task but for sigma and bounds."""

from torch import Tensor

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial


def trust_region(trial: Trial, *, sigma: float | None = None, output: bool = True) -> None:
    """Minimise with the image and the white-box loss where the task has them and `output` is set, else the loss."""
    task = trial.task
    loss = task.output.loss if task.output and output else None
    evaluate = trial.image if loss else trial.loss
    search = zh.optim.TrustRegion(
        trial.start,
        sigma=sigma or task.sigma,
        bounds=task.bounds,
        loss=loss,
        restarts=task.evaluations,  # the harness ends the run
        seed=trial.seed,
    )
    while not search.done:
        search.tell(evaluate(search.ask(max(trial.remaining, 1))))
        width: Tensor = search.sigma * search.unit
        trial.report(search.x, sigma=float(width.mean()), loss=search.value)


def _needs_image(task: Task) -> str | None:
    return None if task.output else "its black box returns the loss only, as trust_region uses it"


METHODS = (
    Method("trust_region", "ours: second order in a trust region, re-using evaluations", with_settings(trust_region)),
    Method(
        "trust_region_loss",
        "the same from the loss alone",
        with_settings(trust_region, output=False),
        _needs_image,
    ),
)
