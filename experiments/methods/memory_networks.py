"""Our methods on network tasks: a layer that remembers its renders, and Newton or Adam steps on the weights.

The layer subtracts what a surrogate of all earlier renders explains (`zh.Memory`). New renders are made for few images
of a batch. With up to 10 parameters the loss is the local entropy, which leaves plateaus where the mean does not. With
more parameters a few draws never hit a valley, and the loss is the mean. This is what a user would write: everything
comes from the public names of the library. All tasks have the same settings, the defaults below, but for CNN wide and
CNN-THROW (see `settings/ours.py`). They were chosen on runs 100 to 104 of CNN and CNN wide, on run 100 of CNN-TEXTURE,
and on runs 100 to 107 of CNN-THROW; `least_steps` on runs 100 to 107 of CNN with 100 renders. The weights in the
coefficient of `zh.Memory` were chosen on runs 14, 16 and 17 of CNN with 1 200 renders, `output_radius` on runs 17, 33
and 36, and `warm_up` on run 8 of CNN-TEXTURE. No table reports one of these runs.

Newton steps are on the weights ("newton"), or on the outputs of the network alone (`zh.optim.NewtonTargets`), to whose
ends the network is fitted ("targets"): by damped least squares, or by Adam if the outputs are many. Steps on the
weights need fewest renders where the surrogate is good, as of CNN. Steps on the outputs suit many outputs, as of
CNN-TEXTURE. Where the black box jumps, as of CNN-THROW, they do better than steps on the weights, and Adam does best.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn

import torch_zerohess as zh
from experiments.methods.annealing import geometric
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.network_training import ANNEALED
from experiments.methods.paper_networks import MOST
from experiments.problems.network_task import NetworkTask
from experiments.runs.network_trial import NetworkTrial

_STEPS = 1000
"""Steps, about: larger budgets get more fresh images per step, a whole number of them."""
_STEPS_ALONE = 4000
"""Steps where all evaluations are used before the first step."""
ROWS = 200
"""Rows of the log, about."""


Update = Callable[[Tensor, float, float], Tensor]
"""(images, share of the training that is over, sigma) -> loss before a step on the weights of the network."""


def through_memory(
    trial: NetworkTrial,
    *,
    steps: Literal["newton", "targets", "adam"],
    batch: int = 16,
    radius: tuple[float, float] = (0.07, 0.003),
    output_radius: float = 0.5,
    damping: float = 3e-4,
    lr: tuple[float, float] = (3e-3, 3e-4),
    target_damping: float = 1e-2,
    target_radius: float = 0.5,
    fit_damping: float = 0.3,
    many_damping: float = 3e-4,
    many_lr: tuple[float, float] = (1e-2, 3e-4),
    warm_up: float = 0.05,
    temperature: float = 0.15,
    least_steps: int = 400,
) -> zh.Memory:
    """Train until the evaluations are used, and return what has been rendered.

    The first renders are around the predictions of the first images, at distances of sigma. A tenth of the evaluations
    is used for them, 20 to 64; of many parameters n + 76, so that an affine map is known. If none are left, training
    goes on with the surrogate alone. Where new renders would last for few steps, steps on the surrogate alone come
    between them: a render tells more than one step can use.

    Args:
        trial: the run.
        steps: "newton" on the weights, "targets" on the outputs, to whose ends the network is fitted, or "adam".
        batch: images of a step.
        radius: first and last trust radius of "newton", in the weights.
        output_radius: longest move of the outputs in a step of "newton", over sigma.
        damping: of "newton".
        lr: first and last learning rate of "adam".
        target_damping: of the Newton steps on up to 10 outputs.
        target_radius: longest Newton step on up to 10 outputs, over sigma.
        fit_damping: of the steps on the weights that follow them.
        many_damping: of the Newton steps on more outputs.
        many_lr: first and last learning rate of Adam, which follows them.
        warm_up: share of the training in which the learning rate grows to its first value. Without it, some networks
            do not train.
        temperature: of the local entropy over the mean loss, with up to 10 parameters.
        least_steps: where fewer steps use all evaluations, steps on the surrogate alone come between them, up to this
            number in all.
    """
    task, network = trial.task, trial.encoder
    error = zh.heads.SquaredError()
    first = min(max(task.evaluations // 10, 20), 64) if task.n <= MOST else min(task.evaluations, task.n + 76)
    fresh = max(1, round((task.evaluations - first) / (2 * _STEPS)))
    rendered = (task.evaluations - first) // (2 * fresh)
    total = max(rendered, least_steps) if rendered else _STEPS_ALONE
    memory = zh.Memory(fresh=fresh, order=2 if steps == "newton" else 1)
    layer = zh.BlackBox(
        trial.image,
        zh.Smoothing(sigma=task.sigma[0], samples=1, baseline="none", order=1 if steps == "adam" else 2),
        head=zh.heads.LocalEntropy(error, temperature) if task.n <= MOST else error,
        memory=memory,
        value="smoothed",
    )
    with torch.no_grad():
        x = network(trial.batch(0, first))
        x = x + task.sigma[0] * torch.randn_like(x)
    memory.add(x, trial.image(x))
    update = {
        "newton": partial(_newton, network, layer, radius, output_radius, damping),
        "targets": partial(_targets, network, layer, target_damping, target_radius, fit_damping)
        if task.n <= MOST
        else partial(_many_targets, network, layer, many_damping, many_lr, warm_up),
        "adam": partial(_adam, network, layer, lr),
    }[steps]()
    for step in range(total):
        share = min(step / (ANNEALED * total), 1.0)
        sigma = geometric(task.sigma, share)
        layer.smoothing = layer.smoothing.replace(sigma=sigma)
        memory.fresh = fresh * ((step + 1) * rendered // total - step * rendered // total)
        loss = update(trial.batch(step, batch), share, sigma)
        every, last = max(1, total // ROWS), step == total - 1
        if step % every == 0 or last:
            trial.report(sigma=sigma, loss=loss, measured=last or step % (10 * every) == 0)
    return memory


def _newton(
    network: nn.Module, layer: zh.BlackBox, radius: tuple[float, float], output_radius: float, damping: float
) -> Update:
    optimizer = zh.optim.NewtonCG(
        network.parameters(),
        radius=radius[0],
        curvature="gauss_newton",
        solver="dual",
        modification="abs",
        damping=damping,
        adapt=False,
    )

    def update(images: Tensor, share: float, sigma: float) -> Tensor:
        def closure() -> tuple[Tensor, Tensor, zh.optim.SampleJacobian]:
            y = network(images)
            return layer(y, images).mean(), y, zh.optim.SampleJacobian(network, images)

        group = optimizer.param_groups[0]
        group["radius"], group["output_radius"] = geometric(radius, share), output_radius * sigma
        return optimizer.step(closure)

    return update


def _targets(network: nn.Module, layer: zh.BlackBox, damping: float, radius: float, fit: float) -> Update:
    newton = zh.optim.NewtonTargets(relative_damping=damping)

    def update(images: Tensor, share: float, sigma: float) -> Tensor:
        y = network(images).detach()
        newton.output_radius = radius * sigma
        zh.optim.move_outputs(network, images, newton(lambda at: layer(at, images), y) - y, relative_damping=fit)
        assert newton.losses is not None
        return newton.losses.mean()

    return update


def _many_targets(
    network: nn.Module, layer: zh.BlackBox, damping: float, lr: tuple[float, float], warm_up: float
) -> Update:
    optimizer, newton = torch.optim.Adam(network.parameters()), zh.optim.NewtonTargets(relative_damping=damping)

    def update(images: Tensor, share: float, sigma: float) -> Tensor:
        y = network(images)
        ends = newton(lambda at: layer(at, images), y)
        descend(optimizer, geometric(lr, share) * min(share / warm_up, 1.0), (y - ends).square().mean())
        assert newton.losses is not None
        return newton.losses.mean()

    return update


def _adam(network: nn.Module, layer: zh.BlackBox, lr: tuple[float, float]) -> Update:
    optimizer = torch.optim.Adam(network.parameters())

    def update(images: Tensor, share: float, sigma: float) -> Tensor:
        loss = layer(network(images), images).mean()
        descend(optimizer, geometric(lr, share), loss)
        return loss.detach()

    return update


def descend(optimizer: torch.optim.Optimizer, lr: float, objective: Tensor) -> None:
    """Take a step along the gradient of an objective."""
    optimizer.param_groups[0]["lr"] = lr
    optimizer.zero_grad()
    objective.backward()
    optimizer.step()


def few_outputs(task: NetworkTask) -> str | None:
    """For methods that need the curvature of each image as a small matrix."""
    if task.n <= MOST:
        return None
    return f"for up to {MOST} outputs of the network, the task has {task.n}"


METHODS = (
    Method(
        "memory_newton",
        "ours: Newton steps on the weights, through a layer that remembers its renders",
        train=with_settings(through_memory, steps="newton"),
        trains=few_outputs,
        uses="image",
    ),
    Method(
        "memory_targets",
        "ours: Newton steps on the outputs, to which the network is fitted, through a layer that remembers its renders",
        train=with_settings(through_memory, steps="targets"),
        uses="image",
    ),
    Method(
        "memory_adam",
        "Adam through the same layer that remembers its renders",
        train=with_settings(through_memory, steps="adam"),
        uses="image",
    ),
)
