"""Points of a box where a model is low, a process uncertain, or other points far: the best of random candidates."""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.search.protocol.random_points import normal, uniform
from torch_zerohess.surrogates.gaussian_process import GaussianProcess

_SCALES = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
"""Distances of candidates from the best point."""
_CANDIDATES = 24
"""Candidates at each of `_SCALES`; four times as many are all over the box."""
_REFINEMENTS = 6
"""Further sets of candidates around the best one."""
_WIDTH, _NARROWING = 0.3, 0.4
"""Distance of candidates in a further set from the best one, and its factor after a set in which none is better."""
_MANY, _ALONG = 4, 4
"""Parameters from which on there are further candidates: so many along each axis through the best one."""
_SAME = 1e-4
"""Distance below which a point is known already."""


def lowest(
    model: Callable[[Tensor], Tensor], best: Tensor, lower: Tensor, upper: Tensor, generator: torch.Generator
) -> Tensor:
    """Return a point [n] of the box where the model, [Q, n] -> [Q], is low: near `best`, or anywhere."""
    n = len(best)
    near = [best + scale * normal(generator, lower, _CANDIDATES, n) for scale in _SCALES]
    candidates = torch.cat([*near, uniform(generator, lower, upper, 4 * _CANDIDATES)]).clamp(lower, upper)
    if n >= _MANY:
        candidates = torch.cat([candidates, _along_axes(best, lower, upper, generator)])
    scores = model(candidates)
    k, width = int(scores.argmin()), _WIDTH
    x, score = candidates[k], float(scores[k])
    for _ in range(_REFINEMENTS):
        candidates = (x + width * normal(generator, lower, 2 * _CANDIDATES, n)).clamp(lower, upper)
        if n >= _MANY:
            candidates = torch.cat([candidates, _along_axes(x, lower, upper, generator)])
        scores = model(candidates)
        k = int(scores.argmin())
        if float(scores[k]) < score:
            x, score = candidates[k], float(scores[k])
        else:
            width *= _NARROWING
    return x


def farthest(points: Tensor, count: int, lower: Tensor, upper: Tensor, generator: torch.Generator) -> Tensor:
    """Return `count` points of the box [count, n], each far from the others and from points [K, n]."""
    spots = uniform(generator, lower, upper, 4 * _CANDIDATES * count)
    distance = torch.cdist(spots, points).amin(1)
    chosen = []
    for _ in range(count):
        chosen.append(spots[int(distance.argmax())])
        distance = torch.minimum(distance, (spots - chosen[-1]).norm(dim=1))
    return torch.stack(chosen)


def is_known(process: GaussianProcess, x: Tensor) -> bool:
    """Whether a point [n] is one of the known points of the process."""
    return float((process.points - x).norm(dim=1).min()) < _SAME


def least_known(process: GaussianProcess, lower: Tensor, upper: Tensor, generator: torch.Generator) -> Tensor:
    """Return a point [n] of the box where the process is uncertain."""
    spots = uniform(generator, lower, upper, 4 * _CANDIDATES)
    return spots[int(process.uncertainty(process.covariance(spots)).argmax())]


def _along_axes(x: Tensor, lower: Tensor, upper: Tensor, generator: torch.Generator) -> Tensor:
    """Return points [R, n] that differ from x [n] in one parameter each."""
    n = len(x)
    places = uniform(generator, lower, upper, _ALONG * n).view(_ALONG, n, n)
    chosen = torch.eye(n, dtype=torch.bool, device=x.device)
    return torch.where(chosen, places, x).view(-1, n)
