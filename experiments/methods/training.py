"""Training a network through a black box with first- and second-order methods, all on the same evaluation counter.

| method | smoothed derivative | step on the weights |
|---|---|---|
| fr22 | gradient of Fischer and Ritschel (2023) | Adam |
| our_g | gradient, aggregate sampling | Adam |
| our_h | Hessian, one sample set per element | Newton-CG with J^T abs(H) J |
| our_hvp | Hessian by differences of independent gradients | Newton-CG with J^T abs(H) J |
| our_hvpa | Hessian from shared aggregate samples | Newton-CG with J^T abs(H) J |
| pooled | gradient of the local entropy, from a model of the image fitted to all renders | Adam (`pooled.py`) |

The names are those of the source; its second-order steps are a nonlinear conjugate gradient on the weights. J is the
Jacobian of the network, H the smoothed Hessian of the black box at one image, from one antithetic pair and therefore
indefinite half of the time: abs takes the magnitude of its eigenvalues. Sigma and the step size (learning rate, trust
radius) go down linearly over nine tenths of the evaluations. Step sizes and batches were chosen on seeds 100 to 102,
which no reported run uses, with renders looked up in a table of angles.
"""

import math
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor, nn

import torch_zerohess as zh
from experiments.methods.pooled import ANNEALED, train_pooled
from experiments.problems.training_task import TrainingTask
from experiments.runs.recorder import Recorder
from experiments.runs.records import Outcome


@dataclass(frozen=True)
class Method:
    """How one method samples and steps. `step` is its first and last learning rate or trust radius."""

    name: str
    optimizer: Literal["adam", "newton", "pooled"]
    """`pooled` has its own settings, which come with the task; those that follow are for the others."""
    proposal: Literal["aggregate", "optimal", "fr22"] = "aggregate"
    batch: int = 1
    step: tuple[float, float] = (0.0, 0.0)
    differences: bool = False
    """Hessian-vector products by finite differences of gradients."""

    def smoothing(self, sigma: float) -> zh.Smoothing:
        order = 2 if self.optimizer == "newton" and not self.differences else 1
        return zh.Smoothing(sigma=sigma, samples=1, proposal=self.proposal, order=order)

    def evaluations(self, n: int) -> int:
        """Renders per image: one antithetic pair per sample set and f(x); differences take two more pairs."""
        return self.smoothing(1.0).evaluations(n) + (4 if self.differences else 0)


METHODS = {
    method.name: method
    for method in (
        Method("fr22", "adam", "fr22", 2, (5e-4, 1e-4)),
        Method("our_g", "adam", "aggregate", 2, (5e-4, 1e-4)),
        Method("our_h", "newton", "optimal", 4, (0.07, 0.003)),
        Method("our_hvp", "newton", "aggregate", 4, (0.07, 0.003), differences=True),
        Method("our_hvpa", "newton", "aggregate", 4, (0.07, 0.003)),
        Method("pooled", "pooled"),
    )
}


@dataclass(frozen=True)
class Result:
    """Outcome of a run: the trained encoder and its held-out errors before and after."""

    method: str
    run: int
    encoder: nn.Module
    start: nn.Module
    seconds: float
    evaluations: int
    image_error: tuple[float, float]
    parameter_error: tuple[float, float]


def train(task: TrainingTask, method: Method, run: int, recorder: Recorder) -> nn.Module:
    """Train a new encoder until the evaluations of the preset are used, and return it.

    `recorder` gets a row per iteration, or with `pooled` one for several.

    Both errors of the first row are of the held-out images. After that the image error is the mean over the batches of
    the last twentieth of the run, which costs no renders; the parameter error is that of the held-out images. `pooled`
    renders no predictions, so that its image error is that of the held-out images, in every tenth row. Run r
    starts from the weights and draws the samples of seed r, the same for all methods.
    """
    encoder, _ = encoders(task, run)
    recorder.row(lambda: (task.image_error(encoder), task.parameter_error(encoder)))
    if method.optimizer == "pooled":

        def report(sigma: float, loss: float, measure: bool) -> None:
            recorder.row(
                lambda: (task.image_error(encoder) if measure else math.nan, task.parameter_error(encoder)),
                sigma=sigma,
                loss=loss,
            )

        train_pooled(task, encoder, run, recorder, report)
    else:
        _train_sampled(task, method, encoder, recorder)
    recorder.stop()
    return encoder


def _train_sampled(task: TrainingTask, method: Method, encoder: nn.Module, recorder: Recorder) -> None:
    """Train with derivatives sampled around the predictions of each batch."""
    steps = max(1, task.preset.evaluations // (method.batch * method.evaluations(task.n)))

    def black_box(x: Tensor, images: Tensor) -> Tensor:
        return recorder.evaluate(task.loss, x, images)

    layer = zh.BlackBox(black_box, method.smoothing(task.sigma[0]))
    sigma = zh.LinearSigma(layer, *task.sigma, steps=max(1, int(ANNEALED * steps)))
    optimizer = _optimizer(method, encoder)
    batches = _batches(task, method.batch)
    losses: deque[float] = deque(maxlen=max(1, steps // 20))
    for iteration in range(steps):
        _set_step(optimizer, method, min(iteration / (ANNEALED * steps), 1.0))
        current = layer.smoothing.sigma
        losses.append(_step(optimizer, method, layer, encoder, next(batches)))
        sigma.step()
        recorder.row(
            lambda: (sum(losses) / len(losses), task.parameter_error(encoder)), sigma=float(current), loss=losses[-1]
        )


def encoders(task: TrainingTask, run: int) -> tuple[nn.Module, nn.Module]:
    """Return two networks with the weights that run r starts from, and seed the samples of its training."""
    torch.manual_seed(run)
    encoder, start = task.preset.encoder(), task.preset.encoder()
    start.load_state_dict(encoder.state_dict())
    return encoder, start


def trained(task: TrainingTask, outcome: Outcome, weights: Path) -> Result:
    """Return the result of a run that has ended, from its outcome and the weights of its encoder."""
    encoder, start = encoders(task, outcome.run)
    encoder.load_state_dict(torch.load(weights, weights_only=True))
    # Of the held-out images, each before and after training.
    image, parameter = ((error(start), error(encoder)) for error in (task.image_error, task.parameter_error))
    return Result(outcome.method, outcome.run, encoder, start, outcome.seconds, outcome.evaluations, image, parameter)


def _optimizer(method: Method, encoder: nn.Module) -> torch.optim.Optimizer:
    if method.optimizer == "adam":
        return torch.optim.Adam(encoder.parameters(), lr=method.step[0])
    return zh.optim.NewtonCG(
        encoder.parameters(),
        radius=method.step[0],
        curvature="gauss_newton",
        iterations=8,
        damping=1e-3,
        adapt=False,
    )


def _set_step(optimizer: torch.optim.Optimizer, method: Method, share: float) -> None:
    name = "lr" if method.optimizer == "adam" else "radius"
    optimizer.param_groups[0][name] = method.step[0] + share * (method.step[1] - method.step[0])


def _step(optimizer: Any, method: Method, layer: zh.BlackBox, encoder: nn.Module, images: Tensor) -> float:
    """Take one step on a batch of images and return the mean loss before it."""
    if method.optimizer == "newton":
        return float(optimizer.step(lambda: _model(method, layer, encoder, images)))
    optimizer.zero_grad()
    loss = layer(encoder(images), images).mean()
    loss.backward()
    optimizer.step()
    return float(loss.detach())


def _model(method: Method, layer: zh.BlackBox, encoder: nn.Module, images: Tensor) -> tuple[Tensor, Tensor]:
    """Return the mean of the local quadratic models around the predictions of the network, and these predictions.

    The white box ends at the predictions y [B, 1]; Newton-CG goes through them with J^T (d2/dy2) J.
    """
    y, fn, smoothing = encoder(images), layer.fn, layer.smoothing
    local = zh.estimate(fn, y, smoothing, images)
    if method.differences:
        # With one parameter, one product is the whole Hessian; a pair cancels every baseline of a gradient.
        pairs = smoothing.replace(baseline="none")
        hessian = zh.finite_difference_hvp(fn, y, torch.ones(1), pairs, images, common=False)[..., None]
    else:
        hessian = local.hessian()
    values, vectors = torch.linalg.eigh(hessian)
    d = y - y.detach()
    along = (vectors.mT @ d[..., None])[..., 0]
    model = local.value + (local.gradient * d).sum(1) + 0.5 * (values.abs() * along**2).sum(1)
    return model.mean(), y


def _batches(task: TrainingTask, size: int) -> Iterator[Tensor]:
    images, _ = task.training
    position = 0
    while True:
        index = torch.arange(position, position + size) % len(images)
        yield images[index]
        position += size
