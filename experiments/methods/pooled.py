"""Training from all renders so far: a surrogate of the black box's image, and a loss smoothed after an exponential.

A render does not depend on the image that it was made for: it can be compared with every training image. A surrogate
of the image, fitted to all renders, therefore gives the losses of a whole batch at all points that are drawn for any of
its images. A larger batch or more steps take no more renders.

Around the prediction x of each image the loss is

    F(x) = -sigma^2 log( E exp(-f(x + sigma u) / T) )        (local entropy: Chaudhari et al. 2017, equation 5)

with the black box's loss f and u ~ N(0, I). The plain mean E f averages a narrow valley away, and its minimum can be a
plateau whose loss is lower than the loss around the valley. exp(-f / T) keeps the valley. The gradient of F is x - E[z]
under the weights N(z; x, sigma) exp(-f(z) / T), and leads to the valley from wherever the valley is sampled. T is
proportional to E f, so that T needs no scale and vanishes with sigma. Expectations are over the points drawn for the
whole batch, weighted by N(z; x, sigma) over the mixture that the points come from (Owen and Zhou 2000), normalised.

Where the image is linear in x, smoothing does not change it, and its Jacobian J is all there is to know. The loss is
then |x - x*|^2 with x* the end of a Gauss-Newton step with J: convergence does not depend on the condition of J.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from experiments.methods.method import Method
from experiments.methods.paper_networks import ANNEALED
from experiments.runs.network_trial import NetworkTrial
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.low_rank import LowRankSurrogate, mean_square_differences
from torch_zerohess.surrogates.process import ProcessSurrogate


@dataclass(frozen=True)
class Pooled:
    """Settings of one task."""

    temperature: float
    """T over the mean loss around the prediction."""
    surrogate: Literal["process", "linear"] = "process"
    """Of the image: a Gaussian process, or an affine map where the image is linear in the parameters."""
    steps: int = 2000
    batch: int = 16
    draws: int = 16
    """Points per image at which the surrogate is evaluated."""
    rank: int = 128
    """Dimensions of the images in the surrogate."""
    rate: tuple[float, float] = (1e-3, 1e-4)
    """First and last learning rate."""
    first: int = 64
    """Renders before the first step."""
    growth: float = 1.3
    """The surrogate is fitted again when there are this times as many renders."""
    rows: int = 200
    """Rows of the log, about."""


class Renders:
    """All renders so far, and their surrogate, which predicts the loss of any parameters for any training image.

    Args:
        pictures: training images [N, *out].
        settings: the surrogate and its rank.
    """

    def __init__(self, pictures: Tensor, settings: Pooled) -> None:
        self._pictures = pictures
        self._linear = LinearSurrogate() if settings.surrogate == "linear" else None
        self._surrogate = LowRankSurrogate(self._linear or ProcessSurrogate(), rank=settings.rank)
        self._points: list[Tensor] = []
        self._images: list[Tensor] = []
        self.evaluations = 0
        """Taken so far."""
        self.solutions: Tensor | None = None
        """[N, n], where a linear surrogate is closest to the training images."""

    def add(self, points: Tensor, images: Tensor) -> None:
        """Take renders: points [K, n], images [K, *out]."""
        self._points.append(points)
        self._images.append(images)
        self.evaluations += len(points)

    def fit(self) -> None:
        """Fit the surrogate to the latest renders, at most its capacity."""
        capacity = self._surrogate.capacity
        self._points, self._images = ([torch.cat(kept)[-capacity:]] for kept in (self._points, self._images))
        self._surrogate.fit(self._points[0], self._images[0])
        self._references = self._surrogate.space.encode(self._pictures)
        if self._linear is not None:
            self.solutions = self._linear.invert(self._references)

    def losses(self, z: Tensor, chosen: Tensor) -> Tensor:
        """Mean squared differences [B, K] of the images expected at z [K, n] to the training images `chosen` [B].

        Without the part of the training images that no render shows.
        """
        return mean_square_differences(self._references[chosen], self._surrogate.coordinates(z))


def pooled(trial: NetworkTrial, given: Mapping[str, Any]) -> None:
    """Train until the evaluations are used, with the fields of `Pooled` as settings.

    Renders are made around the predictions of training images, at distances of sigma. Predictions are not rendered, so
    the image error is measured on the held-out images, in every tenth row and in the last one.
    """
    settings, task, encoder, images = Pooled(**given), trial.task, trial.encoder, trial.images
    optimizer = torch.optim.Adam(encoder.parameters(), lr=settings.rate[0])
    renders = Renders(images, settings)
    budget, fitted, position = task.evaluations, 0, 0
    for step in range(settings.steps):
        share = min(step / (ANNEALED * settings.steps), 1.0)
        sigma = task.sigma[0] * (task.sigma[1] / task.sigma[0]) ** share
        optimizer.param_groups[0]["lr"] = settings.rate[0] + share * (settings.rate[1] - settings.rate[0])
        chosen = torch.arange(position, position + settings.batch) % len(images)
        position += settings.batch
        wanted = min(budget, max(math.ceil(budget * (step + 1) / settings.steps), settings.first))
        if wanted > renders.evaluations:
            points = _around(trial, images[_cycle(chosen, wanted - renders.evaluations, len(images))], sigma)
            renders.add(points, trial.image(points))
        if not fitted or renders.evaluations >= settings.growth * fitted or renders.evaluations == budget > fitted:
            fitted = renders.evaluations
            renders.fit()
        value, loss = _smoothed(trial, settings, renders, encoder(images[chosen]), chosen, sigma)
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
    trial: NetworkTrial, settings: Pooled, renders: Renders, x: Tensor, chosen: Tensor, sigma: float
) -> tuple[Tensor, float]:
    """Return the mean of F over the predictions x [B, n] for training images `chosen` [B], and the mean of f."""
    if renders.solutions is not None:
        loss = renders.losses(x.detach(), chosen).diagonal().mean()
        return (x - renders.solutions[chosen]).square().mean(), float(loss)
    with torch.no_grad():
        points = (x[:, None] + sigma * torch.randn(len(x), settings.draws, x.shape[1])).flatten(0, 1)
        losses = renders.losses(_inside(trial, points), chosen)
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
    Method(
        "pooled",
        "Adam on the local entropy, from a surrogate of the image fitted to all renders",
        train=pooled,
        uses="image",
    ),
)
