"""Shares of confidence intervals that contain the truth, for every sampler and baseline and few draws.

Two functions of two parameters. The wave has 3 and 2.4 radians per sigma: draws of value and gradient are nearly
symmetric. The exponential grows by a factor e^0.3 per sigma of each parameter, as a smooth function with a curvature
of one sign does: draws of its Hessian are skewed, with a few large ones among many small ones. Few draws seldom meet
the large ones, and intervals are too short.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.closed_forms import ClosedForm, Exponential, PlaneWave

_ALLOWED = 0.03
_LEVELS = (0.68, 0.95)
SIGMA = torch.tensor([0.6, 0.4], dtype=torch.float64)
X = torch.tensor([0.3, -0.2], dtype=torch.float64)
V = torch.tensor([0.7, -1.1], dtype=torch.float64)
FUNCTIONS: dict[str, ClosedForm] = {
    "wave": PlaneWave(torch.tensor([3.0, -2.4], dtype=torch.float64) / SIGMA, 0.4),
    "exponential": Exponential(torch.tensor([0.3, 0.3], dtype=torch.float64) / SIGMA),
}
_SEEDS = 5  # batches of the replicates: a batch shares the matrices of its Sobol scrambles
_MOST_SCRAMBLES = 8


@dataclass(frozen=True)
class Coverage:
    """Lowest and highest share over the elements of each quantity at one level."""

    function: str
    setting: str
    draws: int
    level: float
    shares: dict[str, tuple[float, float]]
    verdict: str

    def cells(self) -> list[Any]:
        """Return the row of a table."""
        shown = [self.shares.get(name) for name in ("value", "gradient", "hessian", "hvp")]
        texts = [None if one is None else f"{one[0]:.3f} to {one[1]:.3f}" for one in shown]
        return [self.function, self.setting, self.draws, self.level, *texts, self.verdict]


def coverage(*, seed: int = 0, repeats: int = 2000) -> list[Coverage]:
    """Count how often intervals contain the truth.

    A share that is off by more than 3 points, and three standard deviations of a share, is named as too short or too
    long. It is wrong where draws are many enough or nearly normal, with proposal "aggregate": on the wave 16 draws, or
    scrambles; on the exponential 64 draws at 95 %.
    """
    rows = []
    for name in FUNCTIONS:
        for proposal in ("aggregate", "gaussian", "optimal"):
            for sampler in ("random", "sobol", "orthogonal") if proposal != "optimal" else ("random",):
                for baseline in ("center", "mean", "none"):
                    for antithetic in (True, False):
                        for draws in (4, _MOST_SCRAMBLES) if sampler == "sobol" else (4, 16, 64):
                            settings = {"proposal": proposal, "sampler": sampler, "baseline": baseline}
                            rows += _rows(name, settings, antithetic, draws, seed, repeats)
    return rows


def _rows(name: str, settings: dict[str, Any], antithetic: bool, draws: int, seed: int, repeats: int) -> list[Coverage]:
    sampler, form = settings["sampler"], FUNCTIONS[name]
    samples = draws * {"random": 1, "sobol": 8, "orthogonal": 2}[sampler]
    smoothing = zh.Smoothing(sigma=SIGMA, samples=samples, antithetic=antithetic, **settings)
    hessian = form.hessian(X, SIGMA)
    true = {"value": form.value(X, SIGMA), "gradient": form.gradient(X, SIGMA), "hessian": hessian, "hvp": hessian @ V}
    count = repeats // _SEEDS
    estimates = [
        zh.estimate(form, X.expand(count, 2), smoothing.replace(seed=seed * _SEEDS + one)) for one in range(_SEEDS)
    ]
    setting = f"{settings['proposal']}, {sampler}, {settings['baseline']}, {'pairs' if antithetic else 'single'}"
    many = draws >= 16 or sampler == "sobol"
    rows = []
    for level in _LEVELS:
        shares = {}
        for quantity, exact in true.items():
            v = V if quantity == "hvp" else None
            found = torch.stack([_contained(one, quantity, v, level, exact) for one in estimates]).mean(0)
            shares[quantity] = (float(found.min()), float(found.max()))
        off = _off(shares, level, count * _SEEDS)
        enough = many if name == "wave" else draws == 64 and level == 0.95
        promised = settings["proposal"] == "aggregate" and enough
        verdict = f"WRONG: {off}" if off and promised else off or "right"
        rows.append(Coverage(name, setting, draws, level, shares, verdict))
    return rows


def _off(shares: dict[str, tuple[float, float]], level: float, count: int) -> str:
    """Return which intervals are too short and which too long; nothing if none is."""
    allowed = _ALLOWED + 3 * math.sqrt(level * (1 - level) / count)
    short = [name for name, (least, _) in shares.items() if least < level - allowed]
    long = [name for name, (_, most) in shares.items() if most > level + allowed]
    parts = [f"{what}: {', '.join(names)}" for what, names in (("too short", short), ("too long", long)) if names]
    return "; ".join(parts)


def _contained(estimate: zh.Estimate, quantity: Any, v: Tensor | None, level: float, exact: Tensor) -> Tensor:
    """Share of the intervals of a batch that contain the truth, per element."""
    low, high = estimate.confidence_interval(quantity, v, level=level)
    return ((low <= exact) & (exact <= high)).double().mean(0)
