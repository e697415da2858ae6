"""Shares of confidence intervals that contain the truth, for every sampler and baseline and few draws.

The function is a wave of 3 and 2.4 radians per sigma in two parameters. Draws of value and gradient are then nearly
symmetric. Where they are not, an interval of few draws covers less: the Hessian of proposal "gaussian", whose kernel
has wide tails, and four draws of anything with a preferred sign. With baseline "mean" four draws cover more.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.closed_forms import PlaneWave

_ALLOWED = 0.03
_LEVELS = (0.68, 0.95)
SIGMA = torch.tensor([0.6, 0.4], dtype=torch.float64)
X = torch.tensor([0.3, -0.2], dtype=torch.float64)
V = torch.tensor([0.7, -1.1], dtype=torch.float64)
WAVE = PlaneWave(torch.tensor([3.0, -2.4], dtype=torch.float64) / SIGMA, 0.4)
_SEEDS = 5  # batches of the replicates: a batch shares the matrices of its Sobol scrambles


@dataclass(frozen=True)
class Coverage:
    """Lowest and highest share over the elements of each quantity at one level."""

    setting: str
    draws: int
    level: float
    shares: dict[str, tuple[float, float]]
    verdict: str

    def cells(self) -> list[Any]:
        """Return the row of a table."""
        shown = [self.shares.get(name) for name in ("value", "gradient", "hessian", "hvp")]
        texts = [None if one is None else f"{one[0]:.3f} to {one[1]:.3f}" for one in shown]
        return [self.setting, self.draws, self.level, *texts, self.verdict]


def coverage(*, seed: int = 0, repeats: int = 2000) -> list[Coverage]:
    """Count how often intervals contain the truth.

    What exceeds 3 points, and three standard deviations of a share, is wrong in the settings where draws are many
    enough or nearly normal (16 draws, or scrambles and blocks, of "aggregate"), and is only told in the others.
    """
    rows = []
    for proposal in ("aggregate", "gaussian", "optimal"):
        for sampler in ("random", "sobol", "orthogonal") if proposal != "optimal" else ("random",):
            for baseline in ("center", "mean", "none"):
                for antithetic in (True, False):
                    for draws in (4, 16):
                        settings = {"proposal": proposal, "sampler": sampler, "baseline": baseline}
                        rows += _rows(settings, antithetic, draws, seed, repeats)
    return rows


def _rows(settings: dict[str, Any], antithetic: bool, draws: int, seed: int, repeats: int) -> list[Coverage]:
    sampler = settings["sampler"]
    if sampler == "sobol" and draws == 16:  # eight scrambles are the most
        draws = 8
    samples = draws * {"random": 1, "sobol": 8, "orthogonal": 2}[sampler]
    smoothing = zh.Smoothing(sigma=SIGMA, samples=samples, antithetic=antithetic, **settings)
    hessian = WAVE.hessian(X, SIGMA)
    true = {"value": WAVE.value(X, SIGMA), "gradient": WAVE.gradient(X, SIGMA), "hessian": hessian, "hvp": hessian @ V}
    count = repeats // _SEEDS
    estimates = [
        zh.estimate(WAVE, X.expand(count, 2), smoothing.replace(seed=seed * _SEEDS + one)) for one in range(_SEEDS)
    ]
    name = f"{settings['proposal']}, {sampler}, {settings['baseline']}, {'pairs' if antithetic else 'single'}"
    rows = []
    for level in _LEVELS:
        shares = {}
        for quantity, exact in true.items():
            v = V if quantity == "hvp" else None
            found = torch.stack([_contained(one, quantity, v, level, exact) for one in estimates]).mean(0)
            shares[quantity] = (float(found.min()), float(found.max()))
        most = _ALLOWED + 3 * math.sqrt(level * (1 - level) / (count * _SEEDS))
        within = all(abs(share - level) <= most for pair in shares.values() for share in pair)
        promised = settings["proposal"] == "aggregate" and (draws == 16 or sampler == "sobol")
        verdict = "right" if within else "WRONG" if promised else "few or skewed draws"
        rows.append(Coverage(name, draws, level, shares, verdict))
    return rows


def _contained(estimate: zh.Estimate, quantity: Any, v: Tensor | None, level: float, exact: Tensor) -> Tensor:
    """Share of the intervals of a batch that contain the truth, per element."""
    low, high = estimate.confidence_interval(quantity, v, level=level)
    return ((low <= exact) & (exact <= high)).double().mean(0)
