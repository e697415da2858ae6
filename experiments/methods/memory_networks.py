"""Our methods on network tasks: a layer that remembers its renders, and Newton or Adam steps on the weights.

The layer subtracts what a surrogate of all earlier renders explains (`zh.Memory`). New renders are made for few images
of a batch. The loss is the local entropy, which leaves plateaus where the mean does not. This is what a user would
write: everything comes from the public names of the library. All tasks have the same settings, the defaults below. They
were chosen on runs 100 to 104 of CNN and CNN wide, and on run 100 of CNN-TEXTURE, which no table reports.

With few outputs of the network, Newton steps are on its weights. With many outputs, as the 1024 of CNN-TEXTURE, they
are on the outputs alone (`zh.optim.NewtonTargets`), and Adam fits the network to their ends.
"""

from functools import partial
from typing import Literal

import torch

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.paper_networks import ANNEALED, MOST
from experiments.runs.network_trial import NetworkTrial

_STEPS = 1000
"""Steps at most; larger budgets get more fresh images per step."""
_STEPS_ALONE = 4000
"""Steps where all evaluations are used before the first step."""
_ROWS = 200
"""Rows of the log, about."""


def through_memory(
    trial: NetworkTrial,
    *,
    steps: Literal["newton", "adam"],
    batch: int = 16,
    radius: tuple[float, float] = (0.07, 0.003),
    rate: tuple[float, float] = (3e-3, 3e-4),
    target_rate: tuple[float, float] = (6e-3, 3e-4),
    damping: float = 3e-4,
    temperature: float = 0.15,
) -> None:
    """Train until the evaluations are used.

    The first renders are around the predictions of the first images, at distances of sigma. A tenth of the evaluations
    is used for them, 20 to 64; of many parameters n + 76, so that an affine map is known. If none are left, training
    goes on with the surrogate alone.

    Args:
        trial: the run.
        steps: on the weights.
        batch: images of a step.
        radius: first and last trust radius of "newton".
        rate: first and last learning rate of "adam".
        target_rate: first and last learning rate of Adam on Newton targets.
        damping: of "newton".
        temperature: of the local entropy, over the mean loss.
    """
    task, network = trial.task, trial.encoder
    first = min(max(task.evaluations // 10, 20), 64) if task.n <= MOST else min(task.evaluations, task.n + 76)
    fresh = max(1, round((task.evaluations - first) / (2 * _STEPS)))
    total = (task.evaluations - first) // (2 * fresh)
    few, second = task.n <= MOST, steps == "newton"
    memory = zh.Memory(fresh=fresh, order=2 if second and few else 1)
    layer = zh.BlackBox(
        trial.image,
        zh.Smoothing(sigma=task.sigma[0], samples=1, baseline="none", order=2 if second else 1),
        head=zh.heads.LocalEntropy(zh.heads.SquaredError(), temperature),
        memory=memory,
        value="smoothed",
    )
    with torch.no_grad():
        x = network(trial.batch(0, first))
        x = x + task.sigma[0] * torch.randn_like(x)
    memory.add(x, trial.image(x))
    if not total:  # everything is known that may be known
        memory.fresh, total = 0, _STEPS_ALONE
    newton, adam = _newton(network, radius[0], damping), torch.optim.Adam(network.parameters())
    targets = zh.optim.NewtonTargets(damping=damping)
    group, name, (start, end) = (newton.param_groups[0], "radius", radius)
    if not (second and few):
        group, name, (start, end) = adam.param_groups[0], "lr", target_rate if second else rate
    for step in range(total):
        share = min(step / (ANNEALED * total), 1.0)
        sigma = task.sigma[0] * (task.sigma[1] / task.sigma[0]) ** share
        layer.smoothing = layer.smoothing.replace(sigma=sigma)
        group[name] = start * (end / start) ** share
        chosen = trial.batch(step, batch)

        def closure(chosen: torch.Tensor = chosen) -> tuple[torch.Tensor, torch.Tensor, zh.optim.SampleJacobian]:
            y = network(chosen)
            return layer(y, chosen).mean(), y, zh.optim.SampleJacobian(network, chosen)

        if second and few:
            loss = newton.step(closure)
        else:
            adam.zero_grad()
            y = network(chosen)
            if second:
                ends = targets(partial(_losses, layer, chosen), y)
                assert targets.losses is not None
                loss, objective = targets.losses.mean(), (y - ends).square().mean()
            else:
                loss = objective = layer(y, chosen).mean()
            objective.backward()
            adam.step()
        every, last = max(1, total // _ROWS), step == total - 1
        if step % every == 0 or last:
            trial.report(sigma=sigma, loss=loss.detach(), measured=last or step % (10 * every) == 0)


def _losses(layer: zh.BlackBox, images: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    losses: torch.Tensor = layer(y, images)
    return losses


def _newton(network: torch.nn.Module, radius: float, damping: float) -> zh.optim.NewtonCG:
    return zh.optim.NewtonCG(
        network.parameters(),
        radius=radius,
        curvature="gauss_newton",
        solver="dual",
        modification="abs",
        damping=damping,
        adapt=False,
    )


METHODS = (
    Method(
        "memory_newton",
        "ours: Newton steps on J^T abs(H) J or on many outputs, through a layer that remembers its renders",
        train=with_settings(through_memory, steps="newton"),
        uses="image",
    ),
    Method(
        "memory_adam",
        "Adam through the same layer that remembers its renders",
        train=with_settings(through_memory, steps="adam"),
        uses="image",
    ),
)
