"""ZeroGrads and RELAX on network tasks: the surrogate sees the parameters and the image that they are to explain.

The loss of a prediction depends on the image that it is for, so one surrogate h(z, r) serves all images r: a network of
the parameters z and of r at 8x8 pixels. The targets of CNN-THROW are places, not images; the surrogate sees them as
they are. ZeroGrads fits the surrogate to the losses of the latest batch. RELAX makes it a control variate of the score
function (see `experiments.methods.learned`). The gradient at the predictions goes on through the encoder to its
weights, which Adam moves.

Neither paper has an encoder with a black box after it. ZeroGrads trains a network by taking its 35 000 weights for the
parameters of the black box; here these would be 268 000, and the encoder, which is a white box, would be sampled too.

Both methods see the losses and the training images, but no render, no bounds, no derivative of the black box. The first
sigma is the sigma of the task. Sigma and the learning rate of the encoder go down linearly over nine tenths of the
evaluations, as for the source's methods.
"""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from experiments.methods.annealing import linear
from experiments.methods.learned_gradients import Function, fit, lax, network, slope
from experiments.methods.network_training import step_count, train
from experiments.runs.network_trial import NetworkTrial

SIDE = 8
"""Pixels along the side of the images that the surrogate sees."""


class Surrogate:
    """A network of parameters and images, and the scales that make its inputs and values about 1.

    Args:
        trial: the run; parameters are relative to the mean prediction at its start, in units of the first sigma.
        hidden: widths of the layers.
        activation: between them.
    """

    def __init__(self, trial: NetworkTrial, hidden: Sequence[int], activation: type[nn.Module]) -> None:
        self._trial, self._unit, self._scale = trial, trial.task.sigma[0], 0.0
        with torch.no_grad():
            self._centre = trial.encoder(trial.images[:16]).mean(0)
        inputs = trial.task.n + _seen(trial.images[:1]).shape[1]
        self.network = network(inputs, hidden, activation, trial.seed).float()

    def of(self, images: Tensor) -> Function:
        """Return h(z) for parameters z [K, n] of images [K, *out], one each."""
        seen = _seen(images)
        return lambda z: self.network(torch.cat([(z - self._centre) / self._unit, seen], 1))

    def loss(self, z: Tensor, images: Tensor) -> tuple[Tensor, float]:
        """Return the losses [K] over the mean of the first call, and their mean as it is."""
        losses = self._trial.loss(z, images).float()
        self._scale = self._scale or float(losses.mean()) or 1.0
        return losses / self._scale, float(losses.mean())


def _seen(images: Tensor) -> Tensor:
    """Return what a surrogate sees of images [K, *out]: 8x8 pixels [K, 192], or outputs that are no images as given."""
    return nn.functional.adaptive_avg_pool2d(images, SIDE).flatten(1) if images.ndim == 4 else images.flatten(1)


def _repeated(images: Tensor, count: int) -> Tensor:
    """Return images [K, *out] one batch after the other, [count * K, *out]."""
    return images.repeat(count, *(1 for _ in images.shape[1:]))


def zerograds(
    trial: NetworkTrial,
    *,
    batch: int = 4,
    pairs: int = 1,
    lr: tuple[float, float] = (5e-4, 1e-4),
    inner: float = 0.1,
    fit_lr: float = 1e-3,
    fits: int = 10,
    hidden: Sequence[int] = (64, 64, 64),
) -> None:
    """ZeroGrads: Adam along the gradient of the fitted surrogate at the predictions.

    Args:
        trial: the run.
        batch: images of a step.
        pairs: antithetic pairs per image.
        lr: first and last learning rate of the encoder.
        inner: sigma of the kernel that smooths the loss / sigma of the samples.
        fit_lr: learning rate of the surrogate.
        fits: its steps for every step of the encoder.
        hidden: widths of its layers, with leaky ReLU.
    """
    surrogate = Surrogate(trial, hidden, nn.LeakyReLU)
    fitted = torch.optim.Adam(surrogate.network.parameters(), lr=fit_lr)

    def gradient(y: Tensor, images: Tensor, sigma: float) -> tuple[Tensor, float]:
        centres, seen = y.repeat(2 * pairs, 1), _repeated(images, 2 * pairs)
        u = torch.randn(pairs * len(y), y.shape[1])
        z = centres + sigma * torch.cat([u, -u])
        f, mean = surrogate.loss(z + inner * sigma * torch.randn_like(z), seen)
        fit(surrogate.of(seen), fitted, z, f, fits)
        return slope(surrogate.of(images), y), mean

    _train(trial, batch, 2 * pairs, lr, gradient)


def relax(
    trial: NetworkTrial,
    *,
    batch: int = 4,
    samples: int = 2,
    lr: tuple[float, float] = (5e-4, 1e-4),
    fit_lr: float = 0.01,
    hidden: Sequence[int] = (10,),
) -> None:
    """RELAX for continuous variables (LAX): Adam along the score function with a learned control variate.

    Args:
        trial: the run.
        batch: images of a step.
        samples: per image.
        lr: first and last learning rate of the encoder.
        fit_lr: learning rate of the control variate.
        hidden: widths of its layers, with tanh.
    """
    surrogate = Surrogate(trial, hidden, nn.Tanh)
    tuned = torch.optim.Adam(surrogate.network.parameters(), lr=fit_lr)

    def gradient(y: Tensor, images: Tensor, sigma: float) -> tuple[Tensor, float]:
        centres, seen = y.repeat(samples, 1), _repeated(images, samples)
        u = torch.randn_like(centres)
        f, mean = surrogate.loss(centres + sigma * u, seen)
        gradients = lax(f, surrogate.of(seen), centres, u, sigma)
        tuned.zero_grad()
        (sigma**2 * gradients.square().sum(1).mean()).backward()
        tuned.step()
        return gradients.detach().view(samples, *y.shape).mean(0), mean

    _train(trial, batch, samples, lr, gradient)


def _train(
    trial: NetworkTrial,
    batch: int,
    renders: int,
    lr: tuple[float, float],
    gradient: Callable[[Tensor, Tensor, float], tuple[Tensor, float]],
) -> None:
    """Take all steps of Adam that the evaluations allow.

    Args:
        trial: the run.
        batch: images of a step.
        renders: of a step per image.
        lr: first and last learning rate of the encoder.
        gradient: predictions [B, n] without a graph, their images and sigma -> the gradient [B, n] of the loss of each,
            and the mean loss of the samples.
    """
    optimizer = torch.optim.Adam(trial.encoder.parameters(), lr=lr[0])

    def step(images: Tensor, share: float) -> tuple[float, float]:
        sigma = linear(trial.task.sigma, share)
        y = trial.encoder(images)
        direction, loss = gradient(y.detach(), images, sigma)
        optimizer.zero_grad()
        y.backward(direction / batch)
        optimizer.step()
        return sigma, loss

    train(trial, optimizer, ("lr", lr), batch, step_count(trial, batch, renders), step)
