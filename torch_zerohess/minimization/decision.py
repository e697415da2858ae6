"""Which of the best points in noise has the lowest mean."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.minimization.noise import distinct, lowest_mean
from torch_zerohess.minimization.regression import modelled_minimum

_OTHERS = 2
"""Points with low values, besides the best one and where the search is, that may be best in noise."""


@dataclass(frozen=True)
class Decision:
    """The point with the lowest mean among the best points in noise, the mean, and its standard error."""

    x: Tensor
    value: float
    error: float
    evaluations: int
    """Number of evaluations, including the evaluations for the decision."""


def decide(
    evaluate: Callable[[Tensor], Tensor],
    points: Tensor,
    losses: Tensor,
    likely: list[Tensor],
    bounds: tuple[Tensor, Tensor],
    before: int,
    most: int,
    noise: float,
    *,
    trusted: bool,
) -> tuple[Tensor, float, float] | None:
    """Evaluate the best points again; return the point with the lowest mean, the mean, and its standard error.

    Args:
        evaluate: points [K, n] -> losses [K].
        points: all evaluations [P, n], in order.
        losses: [P].
        likely: points [n] that may be best. The minimum of a regression on all evaluations, near the first of them,
            comes before them, and is trusted.
        bounds: lower and upper [n].
        before: number of evaluations before the decision. Later evaluations belong to an interrupted decision, and are
            used again if they are of the same points.
        most: evaluations that the decision gets.
        noise: standard deviation of a loss.
        trusted: whether a model of many evaluations has chosen the first of the likely points, see `lowest_mean`.
    """
    lowest = torch.where(torch.isfinite(losses), losses, torch.inf)[:before].argsort()[:_OTHERS]
    minimum = modelled_minimum(likely[0], points[:before], losses[:before], noise, bounds)
    if minimum is not None:
        likely, trusted = [minimum, *likely], True
    candidates = distinct([*likely, *points[lowest]])
    unused = list(range(before, len(points)))

    def again(asked: Tensor) -> Tensor:
        told, missing = losses.new_empty(len(asked)), list[int]()
        for k, one in enumerate(asked):
            known = next((j for j in unused if torch.equal(points[j], one)), None)
            if known is None:
                missing.append(k)
            else:  # in any order: evaluations that ran at once may have left gaps
                unused.remove(known)
                told[k] = losses[known]
        if missing:
            told[missing] = evaluate(asked[missing])
        return told

    found = lowest_mean(again, candidates, most, noise, trusted=trusted)
    return None if found is None else (candidates[found[0]], *found[1:])
