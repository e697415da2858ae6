"""Our methods on network tasks: a layer that remembers its renders, and Newton or Adam steps on the weights.

The layer subtracts what a surrogate of all earlier renders explains (`zh.Memory`). New renders are made for few images
of a batch. The loss is the local entropy, which leaves plateaus where the mean does not. This is what a user would
write: everything comes from the public names of the library. All tasks have the same settings, the defaults below. They
were chosen on runs 100 to 104 of CNN and CNN wide, which no table reports.
"""

from typing import Literal

import torch

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.paper_networks import ANNEALED, MOST
from experiments.runs.network_trial import NetworkTrial

_STEPS = 1000
"""Steps at most; larger budgets get more fresh images per step."""
_ROWS = 200
"""Rows of the log, about."""


def through_memory(
    trial: NetworkTrial,
    *,
    steps: Literal["newton", "adam"],
    batch: int = 16,
    radius: tuple[float, float] = (0.07, 0.003),
    rate: tuple[float, float] = (3e-3, 3e-4),
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
        damping: of "newton".
        temperature: of the local entropy, over the mean loss.
    """
    task, network, images = trial.task, trial.encoder, trial.images
    first = min(max(task.evaluations // 10, 20), 64) if task.n <= MOST else min(task.evaluations, task.n + 76)
    fresh = max(1, round((task.evaluations - first) / (2 * _STEPS)))
    total = (task.evaluations - first) // (2 * fresh)
    curvature = 2 if steps == "newton" and task.n <= MOST else 1
    memory = zh.Memory(fresh=fresh, order=curvature)
    layer = zh.BlackBox(
        trial.image,
        zh.Smoothing(sigma=task.sigma[0], samples=1, baseline="none", order=curvature),
        head=zh.heads.LocalEntropy(zh.heads.SquaredError(), temperature),
        memory=memory,
        value="smoothed",
    )
    with torch.no_grad():
        x = network(images[torch.arange(first) % len(images)])
        x = x + task.sigma[0] * torch.randn_like(x)
    memory.add(x, trial.image(x))
    if not total:  # everything is known that may be known
        memory.fresh, total = 0, _STEPS
    newton, adam = _newton(network, task.n, radius[0], damping), torch.optim.Adam(network.parameters())
    group, name, (start, end) = (
        (newton.param_groups[0], "radius", radius) if steps == "newton" else (adam.param_groups[0], "lr", rate)
    )
    for step in range(total):
        share = min(step / (ANNEALED * total), 1.0)
        sigma = task.sigma[0] * (task.sigma[1] / task.sigma[0]) ** share
        layer.smoothing = layer.smoothing.replace(sigma=sigma)
        group[name] = start * (end / start) ** share
        chosen = images[torch.arange(step * batch, (step + 1) * batch) % len(images)]

        def closure(chosen: torch.Tensor = chosen) -> tuple[torch.Tensor, torch.Tensor, zh.optim.SampleJacobian]:
            y = network(chosen)
            return layer(y, chosen).mean(), y, zh.optim.SampleJacobian(network, chosen)

        if steps == "newton":
            loss = newton.step(closure)
        else:
            adam.zero_grad()
            loss = closure()[0]
            loss.backward()
            adam.step()
        every, last = max(1, total // _ROWS), step == total - 1
        if step % every == 0 or last:
            trial.report(sigma=sigma, loss=loss.detach(), measured=last or step % (10 * every) == 0)


def _newton(network: torch.nn.Module, n: int, radius: float, damping: float) -> zh.optim.NewtonCG:
    """Return Newton steps with a dual solve where the outputs are few, and with conjugate gradients where not."""
    few = n <= MOST
    return zh.optim.NewtonCG(
        network.parameters(),
        radius=radius,
        curvature="gauss_newton",
        solver="dual" if few else "clip",
        modification="abs" if few else None,
        iterations=8,
        damping=damping,
        adapt=False,
    )


METHODS = (
    Method(
        "memory_newton",
        "ours: Newton steps on J^T abs(H) J, through a layer that remembers its renders",
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
