"""ZeroGrads and RELAX: descent on gradients that need a learned function h; on network tasks see `learned_networks`.

| method | gradient | network |
|---|---|---|
| zerograds | of the network h, biased | h(z) = f(z) near x, by least squares at the latest samples |
| relax | of the smoothed loss, unbiased; h is a control variate | h makes the variance of the gradient small |

Both see the loss alone: no image, no bounds, no derivative. Both draw samples z = x + sigma u, take a step of Adam on x
with their gradient, and report x. ZeroGrads is Fischer and Ritschel (2024), "ZeroGrads: learning local surrogate losses
for non-differentiable graphics". RELAX is Grathwohl et al. (2018), "Backpropagation through the void"; for continuous
variables it is their LAX estimator.

The network sees the parameters relative to the start in units of `Task.sigma`, and the loss relative to the loss at the
start, for one evaluation. So one setting of it serves losses and parameters of every scale. Sigma falls linearly from
`sigma[0]` to `sigma[1]` in `steps` steps and stays there; in the papers it is constant.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from experiments.methods import learned_networks
from experiments.methods.annealing import Annealing
from experiments.methods.keywords import with_settings
from experiments.methods.learned_gradients import fit, lax, network, slope
from experiments.methods.method import Method
from experiments.runs.trial import Trial


class Scaled:
    """The black box in the units of the network: w = (x - start) / unit, and loss over the loss at the start, less 1.

    trial: whose start is evaluated, for one evaluation.
    """

    def __init__(self, trial: Trial) -> None:
        self._trial, self._unit = trial, trial.task.sigma
        self._first = float(trial.loss(trial.start[None]))
        self._scale = abs(self._first) or 1.0

    def loss(self, w: Tensor) -> Tensor:
        """Return the loss [K] at w [K, n], 0 at the start."""
        return (self._trial.loss(self.outside(w)) - self._first) / self._scale

    def outside(self, w: Tensor) -> Tensor:
        """Return the points [..., n] of the task at w [..., n]."""
        return self._trial.start + self._unit * w

    def report(self, w: Tensor, sigma: float, loss: Tensor) -> None:
        """End an iteration at w [n] with the mean of the losses [K] of its samples."""
        mean = self._first + self._scale * float(loss.mean())
        self._trial.report(self.outside(w), sigma=self._unit * sigma, loss=mean)


def zerograds(
    trial: Trial,
    *,
    pairs: int = 5,
    sigma: tuple[float, float] = (0.33, 0.33),
    steps: int = 100,
    inner: float = 0.1,
    rate: float = 0.01,
    fit_rate: float = 1e-3,
    fits: int = 3,
    moves: int = 1,
    hidden: Sequence[int] = (64, 64, 64),
) -> None:
    """ZeroGrads: Adam along the gradient of a network that is fitted to the latest samples.

    Args:
        trial: the run.
        pairs: antithetic pairs per iteration.
        sigma: of the samples around x, at the start and at the end, over `Task.sigma`.
        steps: from start to end.
        inner: sigma of the kernel that smooths the loss / sigma of the samples: f is called beside the point that its
            value is attributed to.
        rate: learning rate of x, over `Task.sigma`.
        fit_rate: learning rate of the network.
        fits: steps of the network per iteration.
        moves: steps of x per iteration.
        hidden: widths of the layers, with leaky ReLU.
    """
    black, n = Scaled(trial), trial.task.n
    generator = torch.Generator().manual_seed(trial.seed)
    h = network(n, hidden, nn.LeakyReLU, trial.seed)
    fitted = torch.optim.Adam(h.parameters(), lr=fit_rate)
    w = torch.zeros(n, dtype=torch.float64)
    moved, annealing, iteration = torch.optim.Adam([w], lr=rate), Annealing(*sigma, steps), 0
    while True:
        current = annealing(iteration)
        u = torch.randn(pairs, n, generator=generator, dtype=torch.float64)
        z = w + current * torch.cat([u, -u])
        beside = torch.randn(z.shape, generator=generator, dtype=torch.float64)
        f = black.loss(z + inner * current * beside)
        fit(h, fitted, z, f, fits)
        for _ in range(moves):
            w.grad = slope(h, w[None])[0]
            moved.step()
        black.report(w, current, f)
        iteration += 1


def relax(
    trial: Trial,
    *,
    samples: int = 8,
    sigma: tuple[float, float] = (1.0, 0.01),
    steps: int = 100,
    rate: float = 0.1,
    fit_rate: float = 0.01,
    hidden: Sequence[int] = (10,),
) -> None:
    """RELAX for continuous variables (LAX): Adam along the mean of `lax`, whose variance the control variate lowers.

    Args:
        trial: the run.
        samples: per iteration.
        sigma: at the start and at the end, over `Task.sigma`.
        steps: from start to end.
        rate: learning rate of x, over `Task.sigma`.
        fit_rate: learning rate of the control variate.
        hidden: widths of its layers, with tanh.
    """
    black, n = Scaled(trial), trial.task.n
    generator = torch.Generator().manual_seed(trial.seed)
    h = network(n, hidden, nn.Tanh, trial.seed)
    tuned = torch.optim.Adam(h.parameters(), lr=fit_rate)
    w = torch.zeros(n, dtype=torch.float64)
    moved, annealing, iteration = torch.optim.Adam([w], lr=rate), Annealing(*sigma, steps), 0
    while True:
        current = annealing(iteration)
        u = torch.randn(samples, n, generator=generator, dtype=torch.float64)
        f = black.loss(w + current * u)
        gradients = lax(f, h, w, u, current)
        tuned.zero_grad()
        # The mean gradient does not depend on h: variance and second moment have the same gradient in h.
        (current**2 * gradients.square().sum(1).mean()).backward()
        w.grad = gradients.detach().mean(0)
        tuned.step()
        moved.step()
        black.report(w, current, f)
        iteration += 1


METHODS = (
    Method(
        "zerograds",
        "ZeroGrads: Adam along the gradient of a network fitted to the loss nearby",
        with_settings(zerograds),
        train=with_settings(learned_networks.zerograds),
    ),
    Method(
        "relax",
        "RELAX: Adam along the score function with a learned control variate",
        with_settings(relax),
        train=with_settings(learned_networks.relax),
    ),
)
