"""Which of the best points in noise has the lowest mean."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.minimization.noise import distinct, lowest_mean
from torch_zerohess.minimization.record import Record
from torch_zerohess.minimization.regression import modelled_minimum, regression
from torch_zerohess.search.trust_region import TrustRegion

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
    record: Record,
    search: TrustRegion,
    likely: list[Tensor],
    before: int,
    most: int,
    noise: float,
) -> tuple[Tensor, float, float] | None:
    """Evaluate the best points again; return the point with the lowest mean, the mean, and its standard error.

    The minimum of a regression on all evaluations is the first of these points, and is trusted, see `lowest_mean`.
    Without one, the first of the likely points is trusted if a model of many evaluations has chosen it.

    Args:
        evaluate: points [K, n] -> losses [K].
        record: all evaluations.
        search: whose evaluations they are.
        likely: points [n] that may be best.
        before: number of evaluations before the decision. Later evaluations belong to an interrupted decision, and are
            used again if they are of the same points.
        most: evaluations that the decision gets.
        noise: standard deviation of a loss.
    """
    points, losses = record.keeping(search.untouched, search.x)
    lowest = torch.where(torch.isfinite(losses), losses, torch.inf)[:before].argsort()[:_OTHERS]
    fitted, trusted = regression(record, search, before, noise), search.averages
    minimum = None if fitted is None else modelled_minimum(likely[0], fitted, search.bounds)
    if minimum is not None:
        likely, trusted = [minimum, *likely], True
    candidates = distinct([*likely, *points[lowest]])
    unused = list(range(before, len(points)))

    def again(asked: Tensor) -> Tensor:
        values, missing = losses.new_empty(len(asked)), list[int]()
        for k, one in enumerate(asked):
            known = next((j for j in unused if torch.equal(points[j], one)), None)
            if known is None:
                missing.append(k)
            else:  # in any order: evaluations that ran at once may have left gaps
                unused.remove(known)
                values[k] = losses[known]
        if missing:
            values[missing] = evaluate(asked[missing])
        return values

    found = lowest_mean(again, candidates, most, noise, trusted=trusted)
    return None if found is None else (candidates[found[0]], *found[1:])
