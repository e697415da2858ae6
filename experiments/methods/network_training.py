"""Training of an encoder with steps that all cost as many renders: how many there are, and what falls on the way."""

from collections import deque
from collections.abc import Callable

import torch
from torch import Tensor

from experiments.methods.annealing import linear
from experiments.runs.network_trial import NetworkTrial

ANNEALED = 0.9
"""Part of the steps in which sigma and the step size go down."""


def step_count(trial: NetworkTrial, batch: int, renders: int) -> int:
    """Return the steps that the evaluations allow, with so many images and renders per image; at least one."""
    return max(1, trial.task.evaluations // (batch * renders))


def train(
    trial: NetworkTrial,
    optimizer: torch.optim.Optimizer,
    size: tuple[str, tuple[float, float]],
    batch: int,
    steps: int,
    step: Callable[[Tensor, float], tuple[float, float]],
) -> None:
    """Take all steps, and report each.

    The image error of a row is the mean loss of the last twentieth of the run, for no renders.

    Args:
        trial: the run.
        optimizer: of the weights.
        size: name of the step size in the optimizer, and its first and last value.
        batch: images of a step.
        steps: their number.
        step: takes one with a batch of images, and returns its sigma and the mean loss before it. It also gets the
            share of the way from first to last.
    """
    name, ends = size
    losses = deque[float](maxlen=max(1, steps // 20))
    for iteration in range(steps):
        share = min(iteration / (ANNEALED * steps), 1.0)
        optimizer.param_groups[0][name] = linear(ends, share)
        sigma, loss = step(trial.batch(iteration, batch), share)
        losses.append(loss)
        trial.report(sigma=sigma, loss=loss, image_error=sum(losses) / len(losses))
