"""The source's methods on network tasks: first- and second-order training with derivatives sampled per image.

| method | smoothed derivative | step on the weights |
|---|---|---|
| fr22 | gradient of Fischer and Ritschel (2023) | Adam |
| our_g | gradient, aggregate sampling | Adam |
| our_h | Hessian, one sample set per element | Newton-CG with J^T abs(H) J |
| our_hvp | Hessian by differences of independent gradients, along every parameter | Newton-CG with J^T abs(H) J |
| our_hvpa | Hessian from shared aggregate samples | Newton-CG with J^T abs(H) J |

The names are the source's names. Its second-order steps are a nonlinear conjugate gradient on the weights. J is the
Jacobian of the network and H the smoothed Hessian of the black box at one image. H comes from one antithetic pair, so
half of the time it is indefinite: abs takes the magnitude of its eigenvalues. Sigma and the step size (learning rate,
trust radius) go down linearly over nine tenths of the evaluations. Step sizes and batches were chosen on runs 100 to
102, which no table reports, with renders looked up in a table of angles.
"""

from collections.abc import Callable
from functools import partial
from typing import Literal

import torch
from torch import Tensor, nn

import torch_zerohess as zh
from experiments.methods.network_training import ANNEALED, step_count, train
from experiments.problems.network_task import NetworkTask
from experiments.runs.network_trial import NetworkTrial

MOST = 10
"""Parameters up to which a pair of samples per image says something of the curvature."""


def first_order(
    trial: NetworkTrial,
    *,
    proposal: Literal["fr22", "aggregate"],
    batch: int = 2,
    lr: tuple[float, float] = (5e-4, 1e-4),
) -> None:
    """Adam on the weights.

    A gradient from pairs of opposite signs is the same with and without f(x). So f(x) is not evaluated: the loss of a
    row is the mean over the pair, which is larger while sigma is wide.

    Args:
        trial: the run.
        proposal: how the gradient is sampled, with one antithetic pair per image.
        batch: images of a step.
        lr: first and last learning rate.
    """
    smoothing = zh.Smoothing(sigma=trial.task.sigma[0], samples=1, proposal=proposal, baseline="none", order=1)
    layer = zh.BlackBox(trial.loss, smoothing, value="smoothed")
    optimizer = torch.optim.Adam(trial.encoder.parameters(), lr=lr[0])

    def step(images: Tensor) -> float:
        optimizer.zero_grad()
        loss = layer(trial.encoder(images), images).mean()
        loss.backward()
        optimizer.step()
        return float(loss.detach())

    _train(trial, layer, optimizer, ("lr", lr), batch, smoothing.evaluations(trial.task.n, center=False), step)


def second_order(
    trial: NetworkTrial,
    *,
    derivatives: Literal["optimal", "differences", "aggregate"],
    batch: int = 4,
    radius: tuple[float, float] = (0.07, 0.003),
) -> None:
    """Newton-CG on the weights.

    Args:
        trial: the run.
        derivatives: "optimal", "differences" or "aggregate", for our_h, our_hvp and our_hvpa.
        batch: images of a step.
        radius: first and last trust radius.
    """
    differences = derivatives == "differences"
    smoothing = zh.Smoothing(
        sigma=trial.task.sigma[0],
        samples=1,
        proposal="optimal" if derivatives == "optimal" else "aggregate",
        order=1 if differences else 2,
    )
    layer = zh.BlackBox(trial.loss, smoothing)
    optimizer = zh.optim.NewtonCG(
        trial.encoder.parameters(),
        radius=radius[0],
        curvature="gauss_newton",
        iterations=8,
        damping=1e-3,
        adapt=False,
    )

    def step(images: Tensor) -> float:
        return float(optimizer.step(partial(_model, layer, trial.encoder, images, differences=differences)))

    n = trial.task.n
    renders = smoothing.evaluations(n) + (4 * n if differences else 0)  # a difference takes two pairs more
    _train(trial, layer, optimizer, ("radius", radius), batch, renders, step)


def _train(
    trial: NetworkTrial,
    layer: zh.BlackBox,
    optimizer: torch.optim.Optimizer,
    size: tuple[str, tuple[float, float]],
    batch: int,
    renders: int,
    step: Callable[[Tensor], float],
) -> None:
    """Take all steps that the evaluations allow.

    Args:
        trial: the run.
        layer: the black box, whose sigma goes down.
        optimizer: of the weights.
        size: of the steps: its name in the optimizer, first and last.
        batch: images of a step.
        renders: of a step per image.
        step: takes one with a batch of images, and returns the mean loss before it.
    """
    steps = step_count(trial, batch, renders)
    sigma = zh.LinearSigma(layer, *trial.task.sigma, steps=max(1, int(ANNEALED * steps)))

    def annealed_step(images: Tensor, share: float) -> tuple[float, float]:
        current = float(sigma.sigma)
        loss = step(images)
        sigma.step()
        return current, loss

    train(trial, optimizer, size, batch, steps, annealed_step)


def _model(layer: zh.BlackBox, encoder: nn.Module, images: Tensor, *, differences: bool) -> tuple[Tensor, Tensor]:
    """Return the mean of the local quadratic models around the predictions of the network, and these predictions.

    The white box ends at the predictions y [B, n]; Newton-CG goes through them with J^T (d2/dy2) J.
    """
    y, fn, smoothing = encoder(images), layer.fn, layer.smoothing
    x = y.detach()
    local = zh.estimate(fn, x, smoothing, images)
    hessian = hessian_by_differences(fn, x, smoothing, images) if differences else local.hessian()
    values, vectors = torch.linalg.eigh(hessian)
    d = y - x
    along = (vectors.mT @ d[..., None])[..., 0]
    model = local.value + (local.gradient * d).sum(1) + 0.5 * (values.abs() * along**2).sum(1)
    return model.mean(), y


def hessian_by_differences(fn: Callable[..., Tensor], y: Tensor, smoothing: zh.Smoothing, images: Tensor) -> Tensor:
    """Return Hessians [B, n, n] of fn at y [B, n]: a product with every unit vector, made symmetric.

    A pair of opposite signs cancels every baseline of a gradient.
    """
    pairs = smoothing.replace(baseline="none")
    units = torch.eye(y.shape[1], dtype=y.dtype)
    products = [zh.finite_difference_hvp(fn, y, unit, pairs, images, common=False) for unit in units]
    columns = torch.stack(products, -1)
    return 0.5 * (columns + columns.mT)


def has_curvature(task: NetworkTask) -> str | None:
    """Say so where the Hessian of an image has too many elements for one pair of samples."""
    if task.n <= MOST:
        return None
    return f"samples the Hessian of every image with one pair: up to {MOST} parameters, the task has {task.n}"
