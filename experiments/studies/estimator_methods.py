"""The ways to estimate that `error` compares: where points come from, what is subtracted, how points depend."""

from dataclasses import dataclass
from typing import Literal

import torch_zerohess as zh
from experiments.studies.estimator_problems import Function, Problem, Quantities

OURS, PAPER = "aggregate + center", "per-element + none"


@dataclass(frozen=True)
class Method:
    """One way to estimate; `difference` takes the HVP by finite differences of gradients instead."""

    name: str
    proposal: Literal["aggregate", "gaussian", "optimal", "uniform"]
    baseline: Literal["center", "mean", "none"]
    sampler: Literal["random", "sobol", "orthogonal"] = "random"
    antithetic: bool = True
    difference: Literal["independent", "common"] | None = None

    def smoothing(self, budget: int, n: int, sigma: float, seed: int) -> zh.Smoothing:
        """Return the settings with the most samples whose evaluations do not exceed the budget, but at least one."""
        settings = zh.Smoothing(
            sigma=sigma,
            samples=2,
            proposal=self.proposal,
            antithetic=self.antithetic,
            baseline=self.baseline,
            sampler=self.sampler,
            seed=seed,
            order=1 if self.difference else 2,
        )
        if self.difference:
            budget //= 2
        each = settings.evaluations(n, center=False) // 2
        return settings.replace(samples=max(1, (budget - (self.baseline == "center")) // each))

    def estimate(self, problem: Problem, fn: Function, budget: int, seed: int) -> Quantities:
        """Return every quantity this method estimates, from one budget of evaluations of fn."""
        smoothing = self.smoothing(budget, len(problem.x), problem.sigma, seed)
        if self.difference:
            common = self.difference == "common"
            return {"hvp": zh.finite_difference_hvp(fn, problem.x, problem.v, smoothing, common=common)}
        result = zh.estimate(fn, problem.x, smoothing, value="smoothed")
        return {
            "value": result.value,
            "gradient": result.gradient,
            "hessian": result.hessian(),
            "hvp": result.hvp(problem.v),
        }


METHODS = (
    Method(OURS, "aggregate", "center"),
    Method("aggregate + center, sobol", "aggregate", "center", sampler="sobol"),
    Method("aggregate + center, orthogonal", "aggregate", "center", sampler="orthogonal"),
    Method("aggregate + mean", "aggregate", "mean"),
    Method("aggregate + none", "aggregate", "none"),
    Method("gaussian + center", "gaussian", "center"),
    Method("gaussian + center, sobol", "gaussian", "center", sampler="sobol"),
    Method("gaussian + center, orthogonal", "gaussian", "center", sampler="orthogonal"),
    Method("gaussian + none", "gaussian", "none"),
    Method(PAPER, "optimal", "none"),
    Method("per-element + none, unpaired", "optimal", "none", antithetic=False),
    Method("per-element + center", "optimal", "center"),
    Method("uniform + none", "uniform", "none"),
    Method("uniform + center", "uniform", "center"),
    Method("differences, independent", "aggregate", "center", difference="independent"),
    Method("differences, common", "aggregate", "center", difference="common"),
)
