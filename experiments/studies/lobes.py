"""Figure 6 of the source: the densities that perturbations are drawn from, their inverse CDFs, and draws.

Densities and CDFs are written out here and share no code with the sampler; draws are the points of an estimate of the
library. In one dimension a column has the density over a histogram of draws, and the inverse CDF beside the sorted
draws. In two dimensions it has contours of the density over a histogram.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import torch
from matplotlib.figure import Figure
from torch import Tensor

import torch_zerohess as zh

REACH = 5.0
"""Half width of the axes."""
BOX = 5.0
"""Half width of uniform sampling, in units of sigma."""
_BINS = 100
_COMPARED, _LEAST = 10, 5
"""Bins along a side whose shares are compared, and draws that are expected in each."""
_SHOWN = 200
"""Sorted draws that are marked beside an inverse CDF."""
_SETS = 6
"""Sample sets of optimal sampling for two parameters: of the value, two gradient and three Hessian elements."""


@dataclass(frozen=True)
class Lobe:
    """A density of u, one- or two-dimensional, with the CDF if it is one-dimensional."""

    name: str
    density: Callable[[Tensor], Tensor]
    """u [m] -> [m], or u [m, 2] -> [m]."""
    draw: Callable[[int, int], Tensor]
    """Count and seed -> [count] or [count, 2]."""
    cdf: Callable[[Tensor], Tensor] | None = None


def _normal(u: Tensor) -> Tensor:
    return torch.exp(-0.5 * u * u) / math.sqrt(2 * math.pi)


def _gradient(u: Tensor) -> Tensor:
    """The density |u| exp(-u^2/2) / 2."""
    return 0.5 * u.abs() * torch.exp(-0.5 * u * u)


def _gradient_cdf(u: Tensor) -> Tensor:
    tail = 0.5 * torch.exp(-0.5 * u * u)
    return torch.where(u < 0, tail, 1 - tail)


def _hessian(u: Tensor) -> Tensor:
    """The density sqrt(e)/4 |u^2 - 1| exp(-u^2/2)."""
    return 0.25 * (u * u - 1).abs() * torch.exp(0.5 * (1 - u * u))


def _hessian_cdf(u: Tensor) -> Tensor:
    """Eq. 52 of the source with the signs of its second and third branch corrected."""
    part = 0.25 * u * torch.exp(0.5 * (1 - u * u))
    return torch.where(u < -1, -part, torch.where(u > 1, 1 - part, 0.5 + part))


def _normal_cdf(u: Tensor) -> Tensor:
    return torch.special.ndtr(u)


def _joint(first: Callable[[Tensor], Tensor], second: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda u: first(u[:, 0]) * second(u[:, 1])


def _mean(*densities: Callable[[Tensor], Tensor]) -> Callable[[Tensor], Tensor]:
    return lambda u: torch.stack([one(u) for one in densities]).mean(0)


def _points(
    count: int,
    seed: int,
    n: int,
    proposal: Literal["aggregate", "fr22", "optimal", "uniform"],
    order: Literal[1, 2] = 2,
) -> Tensor:
    """Perturbations [sets * count, n] of an estimate at 0 with sigma 1; only "optimal" has more than one set."""
    smoothing = zh.Smoothing(
        sigma=1.0, samples=count, proposal=proposal, antithetic=False, baseline="none", order=order, seed=seed
    )
    x = torch.zeros(n, dtype=torch.float64)
    return zh.estimate(lambda z: z.sum(1), x, smoothing, value="smoothed").points.reshape(-1, n)


def _of_element(number: int) -> Callable[[int, int], Tensor]:
    """Draw from the set of samples of one element of optimal sampling for two parameters, [count, 2]."""
    return lambda count, seed: _points(count, seed, 2, "optimal").reshape(_SETS, count, 2)[number]


def _first(draw: Callable[[int, int], Tensor]) -> Callable[[int, int], Tensor]:
    return lambda count, seed: draw(count, seed)[:, 0]


_GAUSSIAN = _joint(_normal, _normal)
_FIRST_ORDER = _mean(_joint(_gradient, _normal), _joint(_normal, _gradient))
_OFF_DIAGONAL = _joint(_gradient, _gradient)
_SECOND_ORDER = _mean(_joint(_hessian, _normal), _OFF_DIAGONAL, _OFF_DIAGONAL, _joint(_normal, _hessian))
LOBES = (
    Lobe("Gaussian", _normal, _first(_of_element(0)), _normal_cdf),
    Lobe("gradient", _gradient, _first(_of_element(1)), _gradient_cdf),
    Lobe("Hessian, diagonal", _hessian, _first(_of_element(3)), _hessian_cdf),
    Lobe(
        "uniform",
        lambda u: torch.where(u.abs() <= BOX, 1 / (2 * BOX), 0.0).to(u),
        lambda count, seed: _points(count, seed, 1, "uniform")[:, 0],
        lambda u: ((u + BOX) / (2 * BOX)).clamp(0, 1),
    ),
    Lobe("gradient, n = 2", _joint(_gradient, _normal), _of_element(1)),
    Lobe("Hessian, diagonal, n = 2", _joint(_hessian, _normal), _of_element(3)),
    Lobe("Hessian, off-diagonal", _OFF_DIAGONAL, _of_element(4)),
    Lobe("FR22", _OFF_DIAGONAL, lambda count, seed: _points(count, seed, 2, "fr22", 1)),
    Lobe(
        "aggregate, first order",
        _mean(_GAUSSIAN, _FIRST_ORDER),
        lambda count, seed: _points(count, seed, 2, "aggregate", 1),
    ),
    Lobe(
        "aggregate, both orders",
        _mean(_GAUSSIAN, _FIRST_ORDER, _SECOND_ORDER),
        lambda count, seed: _points(count, seed, 2, "aggregate"),
    ),
)
"""All densities; the aggregates have a Gaussian share."""


def inverse(cdf: Callable[[Tensor], Tensor], p: Tensor) -> Tensor:
    """Invert a CDF at p [m] by bisection."""
    low, high = torch.full_like(p, -40.0), torch.full_like(p, 40.0)
    for _ in range(100):
        middle = 0.5 * (low + high)
        below = cdf(middle) < p
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return 0.5 * (low + high)


def draw(path: Path, count: int, seed: int) -> dict[str, float]:
    """Draw figure 6 and return the `distance` of draws and density by lobe.

    Args:
        path: of the PNG.
        count: draws of each lobe.
        seed: of the draws.
    """
    lines = [lobe for lobe in LOBES if lobe.cdf]
    planes = [lobe for lobe in LOBES if not lobe.cdf]
    width = max(len(lines), len(planes))
    figure = Figure(figsize=(3.1 * width, 9), layout="constrained")
    axes = figure.subplots(3, width)
    drawn = {lobe.name: lobe.draw(count, seed) for lobe in LOBES}
    for k, lobe in enumerate(lines):
        _line(axes[0, k], axes[1, k], lobe, drawn[lobe.name])
    for k, lobe in enumerate(planes):
        _plane(axes[2, k], lobe, drawn[lobe.name])
    for axis in (*axes[:2, len(lines) :].flat, *axes[2, len(planes) :]):
        axis.axis("off")
    figure.suptitle(f"densities of u, and {count} draws of each")
    figure.savefig(path, dpi=100)
    return {lobe.name: distance(lobe, drawn[lobe.name]) for lobe in LOBES}


def distance(lobe: Lobe, u: Tensor) -> float:
    """Return the largest difference between draws and density.

    In one dimension it is the distance of Kolmogorov and Smirnov, sup |F_count - F|. In two it is the distance of the
    share of a bin to its probability p in standard deviations sqrt(p (1 - p) / count), of bins with count p >= 5.

    u: [count] or [count, 2].
    """
    count = len(u)
    if lobe.cdf is not None:
        F, rank = lobe.cdf(u.sort().values), torch.arange(count + 1) / count
        return float(torch.maximum(F - rank[:-1], rank[1:] - F).max())
    shares = torch.histogramdd(u, _COMPARED, range=[-REACH, REACH, -REACH, REACH]).hist / count
    parts = 40
    edges = torch.linspace(-REACH, REACH, parts * _COMPARED + 1, dtype=torch.float64)
    middles = 0.5 * (edges[1:] + edges[:-1])
    density = lobe.density(torch.cartesian_prod(middles, middles)).reshape(1, len(middles), len(middles))
    p = torch.nn.functional.avg_pool2d(density, parts)[0] * (2 * REACH / _COMPARED) ** 2
    deviations = (shares - p).abs() / (p * (1 - p) / count).sqrt()
    return float(deviations[count * p >= _LEAST].max())


def _line(top: Any, below: Any, lobe: Lobe, u: Tensor) -> None:
    assert lobe.cdf is not None
    axis = torch.linspace(-REACH, REACH, 1001, dtype=torch.float64)
    edges = torch.linspace(-REACH, REACH, _BINS + 1).numpy()
    heights, _ = torch.histogram(u, torch.from_numpy(edges).to(u))
    top.stairs((heights / len(u) / (2 * REACH / _BINS)).numpy(), edges, fill=True, color="0.8", label="draws")
    top.plot(axis.numpy(), lobe.density(axis).numpy(), color="#c1272d", label="density")
    top.set(title=lobe.name, xlabel="u", ylim=(0, None))
    p = torch.linspace(0, 1, 1002, dtype=torch.float64)[1:-1]
    below.plot(p.numpy(), inverse(lobe.cdf, p).numpy(), color="#c1272d", label="inverse CDF")
    ordered = u.sort().values
    rank = (torch.arange(len(u), dtype=torch.float64) + 0.5) / len(u)
    shown = torch.linspace(0, len(u) - 1, _SHOWN).long()
    below.plot(
        rank[shown].numpy(), ordered[shown].numpy(), ".", color="0.4", markersize=3, label="sorted draws", zorder=0
    )
    below.set(xlabel="p", ylabel="u", ylim=(-REACH, REACH))
    for one in (top, below):
        one.legend(fontsize=7, frameon=False)


def _plane(axis: Any, lobe: Lobe, u: Tensor) -> None:
    bins = _BINS // 2
    shares = torch.histogramdd(u, bins, range=[-REACH, REACH, -REACH, REACH]).hist / len(u)
    axis.imshow(shares.mT.numpy(), origin="lower", extent=(-REACH, REACH, -REACH, REACH), cmap="Greys")
    fine = torch.linspace(-REACH, REACH, 4 * bins + 1, dtype=torch.float64)
    middles = 0.5 * (fine[1:] + fine[:-1])
    density = lobe.density(torch.cartesian_prod(middles, middles)).reshape(4 * bins, 4 * bins)
    axis.contour(middles.numpy(), middles.numpy(), density.mT.numpy(), levels=6, colors="#c1272d", linewidths=0.8)
    axis.set(title=lobe.name, xlabel="u0", ylabel="u1")
