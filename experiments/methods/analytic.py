"""What could be reached with exact derivatives: Adam and Newton on the convolution of the loss, where it is known.

Value, gradient and Hessian of a point together count as one evaluation: the black box is called at every point where
the formula is used.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.methods.annealing import Annealing
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.task import Task
from experiments.runs.trial import Trial


def analytic_1(trial: Trial, *, rate: float = 0.1, start: float = 1.0, end: float = 0.01, steps: int = 300) -> None:
    """First order: Adam with learning rate `rate` in units of `Task.sigma`, sigma annealed as for sampled gradients."""
    x = trial.start.clone().requires_grad_()
    loss, annealing = _counted(trial), Annealing.of(trial.task, start, end, steps)
    optimizer = torch.optim.Adam([x], lr=rate * trial.task.sigma)
    iteration = 0
    while True:
        sigma = annealing(iteration)
        optimizer.zero_grad()
        value = loss(x, sigma)
        value.backward()
        optimizer.step()
        iteration += 1
        trial.report(x, sigma=sigma, loss=value.detach())


def analytic_2(trial: Trial, *, radius: float = 2.0, start: float = 1.0, end: float = 0.01, steps: int = 10) -> None:
    """Second order: `zh.optim.Newton` with shifted eigenvalues; `radius` is that at the start, in units of sigma."""
    x = trial.start.clone().requires_grad_()
    loss, annealing = _counted(trial), Annealing.of(trial.task, start, end, steps)
    optimizer = zh.optim.Newton([x], radius=radius * annealing(0))
    iteration = 0
    while True:
        sigma = annealing(iteration)
        value = optimizer.step(partial(loss, x, sigma))
        iteration += 1
        trial.report(x, sigma=sigma, loss=value)


def _counted(trial: Trial) -> Callable[[Tensor, float], Tensor]:
    """The convolved loss of x [n] at sigma, with a graph; an evaluation of the trial."""
    analytic = trial.task.truth.analytic
    assert analytic is not None

    def loss(x: Tensor, sigma: float) -> Tensor:
        trial.loss(x.detach()[None])
        return analytic(x, sigma)

    return loss


def _is_known(task: Task) -> str | None:
    return "the convolution of the loss is not known" if task.truth.analytic is None else None


_EXACT = "loss, its derivatives in closed form"
METHODS = (
    Method("analytic_1", "Adam with exact gradients", with_settings(analytic_1), _is_known, uses=_EXACT),
    Method("analytic_2", "Newton with exact Hessians", with_settings(analytic_2), _is_known, uses=_EXACT),
)
