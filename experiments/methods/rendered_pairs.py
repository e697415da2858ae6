"""Networks that are fitted to renders of known parameters.

A network of a network task maps an output of the black box to parameters. Each evaluation is therefore a labelled
example: the render, and the parameters of which it is the render. Labels need no further evaluation. A colour beyond
its range is rendered as the nearest one within: where the render does not change with a parameter, J is about zero and
the parameter hardly counts (see below). The methods are

- `memory_pairs`: trains as `memory_newton` does and then fits the network to the evaluations that its memory has kept.
  They lie around the predictions, which approach the parameters of the training images.
- `random_pairs`: renders parameters that are uniform in the range of the network's outputs.
- `prior_pairs`: renders parameters drawn as those of the training images. It knows their distribution.

A parameter counts as much as it changes the render. With the surrogate g of a memory, its Jacobian J at the
parameters x_i of an example, and the network's prediction y, the squared error of an example is

    e_i^T H_i e_i,    e_i = y - x_i,    H_i = J^T J over the mean of its diagonal for all examples,

up to a factor the Gauss-Newton model of |g(y) - g(x_i)|^2. The objective is the mean of sqrt(e_i^T H_i e_i + softness):
a mean of squares would be ruled by the few images that are still far off.

The methods have the same network, number of renders, `fits` and objective. `memory_pairs` begins with the network that
`memory_newton` has trained, its rivals with an untrained one. The settings below were chosen for `memory_pairs` on runs
200 and 201 of CNN5. No table reports one of these runs.
"""

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.methods.annealing import geometric
from experiments.methods.keywords import with_settings
from experiments.methods.memory_networks import ROWS, descend, few_outputs, through_memory
from experiments.methods.method import Method
from experiments.problems.network_task import Encoder, NetworkTask
from experiments.runs.network_trial import NetworkTrial

_PART = 64
"""Points that are rendered, or differentiated, at once."""


def fit_to_pairs(
    trial: NetworkTrial,
    memory: zh.Memory,
    *,
    fits: int = 8000,
    batch: int = 16,
    lr: tuple[float, float] = (4e-3, 3e-5),
    warm_up: int = 100,
    softness: float = 0.01,
) -> None:
    """Fit the network of a run to the evaluations of a memory, by Adam.

    Args:
        trial: the run.
        memory: of renders.
        fits: steps.
        batch: examples of a step.
        lr: first and last learning rate.
        warm_up: steps in which the learning rate grows to its first value.
        softness: added to the squared errors.
    """
    points, images = memory.points, memory.outputs
    memory.fit()
    metric = output_metric(memory.surrogate, points)
    optimizer = torch.optim.Adam(trial.encoder.parameters())
    for step in range(fits):
        k = torch.randint(len(points), (batch,))
        error = trial.encoder(images[k]) - points[k]
        loss = (torch.einsum("bi,bij,bj->b", error, metric[k], error) + softness).sqrt().mean()
        descend(optimizer, geometric(lr, step / fits) * min((step + 1) / warm_up, 1.0), loss)
        every, last = max(1, fits // ROWS), step == fits - 1
        if step % every == 0 or last:
            trial.report(loss=loss.detach(), measured=last or step % (10 * every) == 0)


def output_metric(surrogate: Callable[[Tensor], Tensor], points: Tensor) -> Tensor:
    """Return J^T J [P, n, n] of a surrogate at points [P, n], over the mean of all their diagonals."""

    def output(point: Tensor) -> Tensor:
        return surrogate(point[None])[0].flatten()

    jacobian = torch.func.vmap(torch.func.jacfwd(output))
    metric = torch.cat([j.mT @ j for j in map(jacobian, points.split(_PART))])
    return metric / metric.diagonal(dim1=1, dim2=2).mean().clamp_min(torch.finfo(metric.dtype).tiny)


def _memory_pairs(trial: NetworkTrial, *, newton: Mapping[str, Any] | None = None, **settings: Any) -> None:
    fit_to_pairs(trial, through_memory(trial, steps="newton", **(newton or {})), **settings)


def _drawn_pairs(trial: NetworkTrial, *, draw: Callable[[NetworkTrial], Tensor], **settings: Any) -> None:
    points = draw(trial)
    memory = zh.Memory()
    for part in points.split(_PART):
        memory.add(part, trial.image(part))
    fit_to_pairs(trial, memory, **settings)


def _in_range(trial: NetworkTrial) -> Tensor:
    """Return a point for every evaluation left, uniform in the range of the network's outputs."""
    (encoder,) = (module for module in trial.encoder.modules() if isinstance(module, Encoder))
    return encoder.lower + (encoder.upper - encoder.lower) * torch.rand(trial.remaining, trial.task.n)


def _in_prior(trial: NetworkTrial) -> Tensor:
    """Return a point for every evaluation left, drawn as those of the training images."""
    return trial.task.parameters(trial.remaining, torch.Generator().manual_seed(trial.seed), held_out=False)


def _prior_known(task: NetworkTask) -> str | None:
    """For methods that draw parameters as those of the training images."""
    if task.name == "cnn_throw":
        return "the distribution of the training targets is known through simulations alone"
    return few_outputs(task)


METHODS = (
    Method(
        "memory_pairs",
        "ours: memory_newton, after which the network is fitted to its own renders",
        train=with_settings(_memory_pairs),
        trains=few_outputs,
        uses="image",
    ),
    Method(
        "random_pairs",
        "fits the network to renders of parameters that are uniform in the range of its outputs",
        train=with_settings(_drawn_pairs, draw=_in_range),
        trains=few_outputs,
        uses="image, range",
    ),
    Method(
        "prior_pairs",
        "fits the network to renders of parameters that are distributed as those of the training images",
        train=with_settings(_drawn_pairs, draw=_in_prior),
        trains=_prior_known,
        uses="image, distribution",
    ),
)
