"""Adam on the renderer's own derivative: what a user of Mitsuba does today.

| method | integrator |
|---|---|
| mitsuba | prb |
| mitsuba_path | path |
| mitsuba_projective | direct_projective where direct light is enough, prb_projective elsewhere |

One step is two evaluations, a render and its adjoint. The loss is the loss of the task: its reference and all renders
have one seed. The adjoint pass has a fresh seed at every step unless asked otherwise.
"""

from typing import Literal

import torch

from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial

_LEAST = 0.01
"""Learning rate at the end, over that at the start."""


def adjoint_adam(
    trial: Trial,
    *,
    integrator: Literal["path", "prb", "projective"],
    rate: float = 0.1,
    steps: int = 100,
    fresh: bool = True,
) -> None:
    """Adam within the bounds of the task.

    Args:
        trial: the run.
        integrator: of the adjoint pass.
        rate: learning rate at the start, in units of `Task.sigma`; it falls linearly to a hundredth of that.
        steps: from start to end.
        fresh: whether every adjoint pass has a seed of its own.
    """
    task = trial.task
    assert task.renderer is not None
    name = next(one for one in reversed(task.renderer.adjoints) if one.endswith(integrator))
    x = trial.start.clone().requires_grad_()
    optimizer = torch.optim.Adam([x], lr=rate * task.sigma)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, _LEAST, steps)
    seeds = torch.Generator().manual_seed(trial.seed)
    while True:
        seed = int(torch.randint(2**31, (), generator=seeds)) if fresh else 1
        loss, x.grad = trial.adjoint(x, name, seed)
        optimizer.step()
        schedule.step()
        if task.bounds is not None:
            x.data.clamp_(*task.bounds)
        trial.report(x, loss=loss)


def _differentiable(task: Task) -> str | None:
    if task.renderer is None or task.renderer.adjoint is None:
        return "the black box has no derivative of its own"
    return task.renderer.no_adjoint()


METHODS = tuple(
    Method(
        name,
        f"Mitsuba's own derivative {title}, Adam",
        with_settings(adjoint_adam, integrator=integrator),
        _differentiable,
        ("mitsuba",),
        another_scene=True,
        uses="loss, its derivative by the renderer",
    )
    for name, title, integrator in (
        ("mitsuba", "(prb)", "prb"),
        ("mitsuba_path", "(path)", "path"),
        ("mitsuba_projective", "with samples on silhouettes", "projective"),
    )
)
