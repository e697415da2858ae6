"""TuRBO-1: Bayesian optimization in a trust region, by Thompson sampling (Eriksson et al. 2019).

Eriksson, Pearce, Gardner, Turner and Poloczek, "Scalable global optimization via local Bayesian optimization". It sees
the loss and the bounds, and no derivative of the black box. Model (Matern 5/2, bounds of lengths, scale and noise, 50
steps of Adam), region and candidates have the published settings, and one point is evaluated at a time.

A region is a box in the unit cube around the best point, with sides proportional to the lengths of the model and the
geometric mean `length`. When it is shorter than `SHORTEST`, a new region begins with new points, and the old ones are
forgotten. The first region begins with the start and 2 n - 1 points of a Latin hypercube, later ones with 2 n points.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.methods.bayesian import Cube
from experiments.methods.best import Best
from experiments.methods.bounds import is_bounded
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.runs.trial import Trial

FIRST, SHORTEST, LONGEST = 0.8, 0.5**7, 1.6
"""Lengths of a region, whose cube has side 1."""
SUCCESSES = 3
"""Successes in a row after which the length is doubled."""
GAIN = 1e-3
"""An evaluation is a success if it is lower than the best by more than this part of the best."""
EVALUATIONS = 100
"""Evaluations after which the method ends, if not set."""


@dataclass
class Region:
    """The length of a trust region of n parameters, and the counts that change it."""

    n: int
    length: float = FIRST
    successes: int = 0
    failures: int = 0

    @property
    def tolerance(self) -> int:
        """Failures in a row after which the length is halved, for one point at a time."""
        return max(4, self.n)

    @property
    def ended(self) -> bool:
        return self.length < SHORTEST

    def tell(self, loss: float, best: float) -> None:
        """Take a new loss, and the lowest before it."""
        if loss < best - GAIN * abs(best):
            self.successes, self.failures = self.successes + 1, 0
        else:
            self.successes, self.failures = 0, self.failures + 1
        if self.successes == SUCCESSES:
            self.length, self.successes = min(2.0 * self.length, LONGEST), 0
        elif self.failures == self.tolerance:
            self.length, self.failures = 0.5 * self.length, 0


def turbo(trial: Trial, *, evaluations: int = EVALUATIONS, steps: int = 50) -> None:
    """Evaluate the minimiser of a draw of the model among the candidates in the region, again and again.

    Args:
        trial: the run.
        evaluations: after which the method ends.
        steps: of Adam, for every fit.
    """
    from scipy.stats import qmc  # most of a second, which other methods need not wait for

    n, cube, best = trial.task.n, Cube(trial), Best(trial)
    generator = np.random.default_rng(trial.seed)
    used, first = 0, cube.start
    while True:
        latin = qmc.LatinHypercube(n, rng=generator).random(2 * n - len(first))
        design = torch.cat([first, torch.from_numpy(latin)])
        region, z, losses = Region(n), design[:0], design.new_empty(0)
        while not region.ended:
            begun = len(z) >= len(design)
            following = candidate(z, losses, region.length, steps, generator) if begun else design[len(z), None]
            x = cube.outside(following)
            loss = trial.loss(x)
            if begun:
                region.tell(float(loss), float(losses.min()))
            z, losses, used = torch.cat([z, following]), torch.cat([losses, loss]), used + 1
            best(x.numpy(), loss.numpy())
            if used == evaluations:
                return
        first = cube.start[:0]


def box(centre: Tensor, lengths: Tensor, length: float) -> tuple[Tensor, Tensor]:
    """Return the lower and upper corner [n] of a region in the unit cube.

    Args:
        centre: [n].
        lengths: of the kernel [n], to which the sides are proportional.
        length: geometric mean of the sides, before they are cut to the cube.
    """
    sides = length * lengths / lengths.log().mean().exp()
    return (centre - sides / 2).clamp(0.0, 1.0), (centre + sides / 2).clamp(0.0, 1.0)


def candidate(z: Tensor, losses: Tensor, length: float, steps: int, generator: np.random.Generator) -> Tensor:
    """Return the candidate [1, n] at which a draw of the model of losses [N] at z [N, n] is lowest."""
    n, count = z.shape[1], min(100 * z.shape[1], 5000)
    spread = float(losses.std(correction=0))
    scaled = (losses - losses.median()) / (spread if spread >= 1e-6 else 1.0)
    model = _model(z, scaled, steps)
    centre = z[int(losses.argmin())]
    lower, upper = box(centre, model.covar_module.base_kernel.lengthscale.detach()[0], length)
    sobol = torch.quasirandom.SobolEngine(n, scramble=True, seed=int(generator.integers(10**6)))
    moved = lower + (upper - lower) * sobol.draw(count, dtype=torch.float64)
    # A candidate differs from the centre in 20 coordinates on average, and at least in one.
    mask = torch.from_numpy(generator.random((count, n))) <= min(20.0 / n, 1.0)
    mask[torch.arange(count), torch.from_numpy(generator.integers(n, size=count))] |= ~mask.any(1)
    candidates = torch.where(mask, moved, centre)
    with torch.no_grad():
        posterior = model.likelihood(model(candidates))
    # The covariance of a smooth function at close points has negative eigenvalues by rounding: they are cut at 0.
    values, vectors = torch.linalg.eigh(posterior.covariance_matrix)
    normal = torch.from_numpy(generator.standard_normal(count))
    draw = posterior.mean + vectors @ (values.clamp_min(0.0).sqrt() * normal)
    return candidates[int(draw.argmin()), None]


def _model(z: Tensor, losses: Tensor, steps: int) -> Any:
    """Return the Gaussian process fitted to losses [N] at z [N, n]."""
    from botorch.models import SingleTaskGP
    from gpytorch.constraints import Interval
    from gpytorch.kernels import MaternKernel, ScaleKernel
    from gpytorch.likelihoods import GaussianLikelihood
    from gpytorch.mlls import ExactMarginalLogLikelihood

    kernel = ScaleKernel(
        MaternKernel(nu=2.5, ard_num_dims=z.shape[1], lengthscale_constraint=Interval(0.005, 2.0)),
        outputscale_constraint=Interval(0.05, 20.0),
    )
    likelihood = GaussianLikelihood(noise_constraint=Interval(5e-4, 0.2))
    model: Any = SingleTaskGP(z, losses[:, None], likelihood=likelihood, covar_module=kernel, outcome_transform=None)
    model.initialize(
        **{
            "covar_module.outputscale": 1.0,
            "covar_module.base_kernel.lengthscale": 0.5,
            "likelihood.noise": 0.005,
        }
    )
    evidence = ExactMarginalLogLikelihood(likelihood, model)
    optimizer = torch.optim.Adam(model.parameters(), lr=0.1)
    for _ in range(steps):
        optimizer.zero_grad()
        (-evidence(model(z), losses)).backward()
        optimizer.step()
    return model.eval()


METHODS = (
    Method(
        "turbo",
        f"TuRBO-1 (GPyTorch), Thompson sampling of the loss in a trust region, {EVALUATIONS} evaluations",
        with_settings(turbo),
        is_bounded,
        ("botorch", "scipy"),
    ),
)
