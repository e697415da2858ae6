"""Training from all renders so far: a model of the black box's image, and a loss smoothed after an exponential.

A render can be compared with every training image, not only with the one that it was made for. So a model of the image
(`ImageModel`), fitted to all renders, gives the losses of a whole batch at all points drawn for any image of the batch.
A larger batch and more steps then take no further renders.

Around the prediction x of each image the loss is

    F(x) = -sigma^2 log( E exp(-f(x + sigma u) / T) )        (local entropy: Chaudhari et al. 2017, equation 5)

with the loss f of the black box and u ~ N(0, I). The mean of f averages a narrow valley away and leads into a plateau
that is lower than its surroundings; exp(-f / T) keeps the valley. The gradient of F is x - E[z] under the weights
N(z; x, sigma) exp(-f(z) / T): it leads to the valley as soon as a sample falls into the valley. T is a share of the
mean loss around x, so it has no scale to choose and vanishes with sigma. Expectations are over the points drawn for the
batch, with self-normalised weights N(z; x, sigma) / density of the mixture that they come from (Owen and Zhou 2000).

Where the image is linear in x, smoothing does not change it, and its Jacobian J says everything. The loss is then
|x - x*|^2, with x* the end of a Newton step with J^T J: convergence does not depend on the condition of J.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from experiments.methods.image_model import ImageModel
from experiments.methods.method import Method
from experiments.methods.paper_networks import ANNEALED
from experiments.runs.network_trial import NetworkTrial


@dataclass(frozen=True)
class Pooled:
    """Settings of one task."""

    lengths: tuple[float, ...] | None
    """Of the covariance of the image model per parameter; None for a linear one."""
    temperature: float
    """T over the mean loss around the prediction."""
    steps: int = 2000
    batch: int = 16
    draws: int = 16
    """Points per image at which the model is evaluated."""
    rank: int = 128
    """Dimensions of the images in the model."""
    rate: tuple[float, float] = (1e-3, 1e-4)
    """First and last learning rate."""
    first: int = 64
    """Renders before the first step."""
    growth: float = 1.3
    """The model is fitted again when there are this times as many renders."""
    rows: int = 200
    """Rows of the log, about."""


def pooled(trial: NetworkTrial, given: Mapping[str, Any]) -> None:
    """Train until the evaluations are used, with the fields of `Pooled` as settings.

    Renders are made around the predictions of training images, at distances of sigma. Predictions are not rendered, so
    the image error is measured on the held-out images, in every tenth row and in the last one.
    """
    settings, task, encoder, images = Pooled(**given), trial.task, trial.encoder, trial.images
    optimizer = torch.optim.Adam(encoder.parameters(), lr=settings.rate[0])
    model = ImageModel(images.flatten(1), settings.lengths, settings.rank, trial.run)
    budget, fitted, position = task.evaluations, 0, 0
    for step in range(settings.steps):
        share = min(step / (ANNEALED * settings.steps), 1.0)
        sigma = task.sigma[0] * (task.sigma[1] / task.sigma[0]) ** share
        optimizer.param_groups[0]["lr"] = settings.rate[0] + share * (settings.rate[1] - settings.rate[0])
        chosen = torch.arange(position, position + settings.batch) % len(images)
        position += settings.batch
        wanted = min(budget, max(math.ceil(budget * (step + 1) / settings.steps), settings.first))
        if wanted > model.evaluations:
            points = _around(trial, images[_cycle(chosen, wanted - model.evaluations, len(images))], sigma)
            model.add(points, trial.image(points))
        if not fitted or model.evaluations >= settings.growth * fitted or model.evaluations == budget > fitted:
            fitted = model.evaluations
            model.fit()
        value, loss = _smoothed(trial, settings, model, encoder(images[chosen]), chosen, sigma)
        optimizer.zero_grad()
        value.backward()
        optimizer.step()
        every, last = max(1, settings.steps // settings.rows), step == settings.steps - 1
        if step % every == 0 or last:
            trial.report(sigma=sigma, loss=loss, measured=last or step % (10 * every) == 0)


def _cycle(chosen: Tensor, count: int, images: int) -> Tensor:
    """Return the numbers [count] of training images: those of a batch, and the next ones if it has too few."""
    return (chosen[0] + torch.arange(count)) % images


def _around(trial: NetworkTrial, images: Tensor, sigma: float) -> Tensor:
    """Draw a point [B, n] around the prediction for each image."""
    with torch.no_grad():
        x = trial.encoder(images)
        return _inside(trial, x + sigma * torch.randn_like(x))


def _inside(trial: NetworkTrial, x: Tensor) -> Tensor:
    bounds = trial.task.bounds
    return x if bounds is None else x.clamp(*(torch.tensor(bound) for bound in bounds))


def _smoothed(
    trial: NetworkTrial, settings: Pooled, model: ImageModel, x: Tensor, chosen: Tensor, sigma: float
) -> tuple[Tensor, float]:
    """Return the mean of F over the predictions x [B, n] for training images `chosen` [B], and the mean of f."""
    if settings.lengths is None:
        loss = (model(x.detach()) - model.references[chosen]).square().sum(1).mean()
        return (x - model.solutions[chosen]).square().mean(), float(loss)
    with torch.no_grad():
        points = (x[:, None] + sigma * torch.randn(len(x), settings.draws, x.shape[1])).flatten(0, 1)
        losses = model.distances(model(_inside(trial, points)), chosen)
    return local_entropy(x, points, losses, sigma, settings.temperature)


def local_entropy(x: Tensor, points: Tensor, losses: Tensor, sigma: float, temperature: float) -> tuple[Tensor, float]:
    """Return the mean of F over x [B, n], and that of E f.

    Args:
        x: centres, with a graph.
        points: [K, n], the same number from N(x, sigma^2) of each centre.
        losses: [B, K] of each centre at all points.
        sigma: of the smoothing.
        temperature: T over the smoothed loss E f of each centre.
    """
    logs = -0.5 * ((x[:, None] - points) / sigma).square().sum(2)
    logs = logs - torch.logsumexp(logs.detach(), 0)
    smoothed = (logs.detach().softmax(1) * losses).sum(1, keepdim=True)
    tempered = logs - losses / (temperature * smoothed).clamp_min(torch.finfo(losses.dtype).tiny)
    entropy = torch.logsumexp(tempered, 1) - torch.logsumexp(logs, 1)
    return -(sigma**2) * entropy.mean(), float(smoothed.mean())


METHODS = (
    Method("pooled", "Adam on the local entropy, from a model of the image fitted to all renders", train=pooled),
)
