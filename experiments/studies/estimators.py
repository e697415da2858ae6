"""The estimators that `variance` compares: their proposal, their baseline, and the dependence between their points."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch

import torch_zerohess as zh
from experiments.studies.estimator_problems import Function, Problem, Quantities

OURS, PAPER = "aggregate + center", "per-element + none"
_EARLIER = 4
"""Calls of 64 evaluations that a memory has seen before it is used."""


@dataclass(frozen=True)
class Estimator:
    """One way to estimate; `difference` takes the HVP by finite differences of gradients instead."""

    name: str
    proposal: Literal["aggregate", "gaussian", "optimal", "uniform", "auto"]
    baseline: Literal["center", "mean", "none", "auto"]
    sampler: Literal["random", "sobol", "orthogonal", "auto"] = "random"
    antithetic: bool | Literal["auto"] = True
    difference: Literal["independent", "common"] | None = None
    memory: Literal["process", "untrained"] | None = None
    """Surrogate of the control variate: a Gaussian process of earlier evaluations, or an untrained random network."""
    order: Literal[1, 2] = 2
    """Highest derivative: with 1 there are neither lobes nor sample sets for the second."""

    def samples(self, budget: int, n: int) -> int:
        """Return how many evaluations every element of a quantity is a mean of."""
        return self.smoothing(budget, n, 1.0, 0).samples * (2 if self.antithetic else 1)

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
            order=1 if self.difference else self.order,
        )
        if self.difference:
            budget //= 2
        each = settings.evaluations(n, center=False) // 2
        chosen = settings.replace(samples=max(1, budget // each))
        if chosen.resolved(n).baseline != "center":
            return chosen
        return settings.replace(samples=max(1, (budget - 1) // each))

    def estimate(self, problem: Problem, counted: Callable[[Function], Function], budget: int, seed: int) -> Quantities:
        """Return every quantity this method estimates, from one budget of evaluations.

        Args:
            problem: with the black box.
            counted: makes a black box count its evaluations.
            budget: evaluations at most.
            seed: of the samples.
        """
        smoothing = self.smoothing(budget, len(problem.x), problem.sigma, seed)
        if self.difference:
            common = self.difference == "common"
            return {
                "hvp": zh.finite_difference_hvp(counted(problem.fn), problem.x, problem.v, smoothing, common=common)
            }
        memory = copy.deepcopy(self._remembered(problem)) if self.memory else None
        result = _estimate(problem, counted, smoothing, memory)
        first = {"value": result.value, "gradient": result.gradient}
        return first if self.order == 1 else {**first, "hessian": result.hessian(), "hvp": result.hvp(problem.v)}

    def _remembered(self, problem: Problem) -> zh.Memory:
        """Return a memory that has served a few estimates of this kind at the same point."""
        key = self.name
        if key not in problem.memories:
            torch.manual_seed(0)
            shape = torch.Size() if problem.reference is None else problem.reference.shape
            memory = zh.Memory(_Untrained(len(problem.x), shape) if self.memory == "untrained" else None)
            for call in range(_EARLIER):
                smoothing = self.smoothing(64, len(problem.x), problem.sigma, call)
                _estimate(problem, lambda fn: fn, smoothing, memory)
            if self.memory == "process":
                memory.fit()
            problem.memories[key] = memory
        return problem.memories[key]


def _estimate(
    problem: Problem, counted: Callable[[Function], Function], smoothing: zh.Smoothing, memory: zh.Memory | None
) -> zh.Estimate:
    """Estimate from the loss or, with a memory, from the image where there is one."""
    if memory is None or problem.image is None or problem.reference is None:
        return zh.estimate(counted(problem.fn), problem.x, smoothing, value="smoothed", memory=memory)
    return zh.estimate(
        counted(problem.image),
        problem.x,
        smoothing,
        problem.reference,
        head=zh.heads.SquaredError(),
        value="smoothed",
        memory=memory,
    )


class _Untrained(torch.nn.Module):
    """A random network, points [K, n] to outputs [K, *out]."""

    def __init__(self, n: int, shape: torch.Size) -> None:
        super().__init__()
        elements = shape.numel()
        self.layers = torch.nn.Sequential(torch.nn.Linear(n, 32), torch.nn.Tanh(), torch.nn.Linear(32, elements))
        self.shape = shape

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        out: torch.Tensor = self.layers(z.float()).reshape(len(z), *self.shape)
        return out


ESTIMATORS = (
    Estimator(OURS, "aggregate", "center"),
    Estimator("auto", "auto", "auto", sampler="auto", antithetic="auto"),
    Estimator("aggregate + center, sobol", "aggregate", "center", sampler="sobol"),
    Estimator("aggregate + center, orthogonal", "aggregate", "center", sampler="orthogonal"),
    Estimator("aggregate + center, memory", "aggregate", "center", memory="process"),
    Estimator("aggregate + center, untrained network", "aggregate", "center", memory="untrained"),
    Estimator("aggregate + mean", "aggregate", "mean"),
    Estimator("aggregate + none", "aggregate", "none"),
    Estimator("gaussian + center", "gaussian", "center"),
    Estimator("gaussian + center, sobol", "gaussian", "center", sampler="sobol"),
    Estimator("gaussian + center, orthogonal", "gaussian", "center", sampler="orthogonal"),
    Estimator("gaussian + center, memory", "gaussian", "center", memory="process"),
    Estimator("gaussian + mean", "gaussian", "mean"),
    Estimator("gaussian + none", "gaussian", "none"),
    Estimator(PAPER, "optimal", "none"),
    Estimator("per-element + none, unpaired", "optimal", "none", antithetic=False),
    Estimator("per-element + center", "optimal", "center"),
    Estimator("per-element + center, memory", "optimal", "center", memory="process"),
    Estimator("uniform + none", "uniform", "none"),
    Estimator("uniform + center", "uniform", "center"),
    Estimator("uniform + center, memory", "uniform", "center", memory="process"),
    Estimator("differences, independent", "aggregate", "center", difference="independent"),
    Estimator("differences, common", "aggregate", "center", difference="common"),
)
NAMES = tuple(method.name for method in ESTIMATORS)
OPERATORS = tuple(
    f"{kind} + {baseline}" for kind in ("uniform", "aggregate", "per-element") for baseline in ("none", "center")
)
"""Ways to estimate in figure 11."""
FIRST_ORDER = ", first order"
"""Ends the names of those that estimate the gradient alone."""
ALONE = tuple(replace(one, name=one.name + FIRST_ORDER, order=1) for one in ESTIMATORS if one.name in OPERATORS)
