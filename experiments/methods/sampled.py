"""Sampled derivatives for first-order methods: value and gradient of the smoothed black box."""

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.runs.trial import Trial


class SampledGradient:
    """F(x) = E f(x + sigma u) and its gradient from antithetic pairs of perturbations.

    trial: whose black box is sampled.
    samples: pairs; an estimate costs 2 samples + 1 evaluations.
    frozen: whether every estimate uses the same perturbations. The noise is then a function of x and sigma, so the
        difference of two gradients has little of it. Value and gradient are separate estimates even then: the gradient
        is not exactly the gradient of the value.
    """

    def __init__(self, trial: Trial, samples: int, *, frozen: bool) -> None:
        self._trial, self._samples, self._frozen = trial, samples, frozen
        self._seeds = torch.Generator().manual_seed(trial.seed)

    def __call__(self, x: Tensor, sigma: float) -> tuple[float, Tensor]:
        """Return the value and the gradient [n] at x [n]."""
        estimate = zh.estimate(self._trial.loss, x.detach(), self._smoothing(sigma), value="smoothed")
        return float(estimate.value), estimate.gradient

    def value(self, x: Tensor, sigma: float) -> float:
        """Return the value at x [n] alone, for as many evaluations."""
        return self(x, sigma)[0]

    def _smoothing(self, sigma: float) -> zh.Smoothing:
        seed = self._trial.seed if self._frozen else int(torch.randint(2**62, (), generator=self._seeds))
        return zh.Smoothing(sigma=sigma, samples=self._samples, order=1, seed=seed)
