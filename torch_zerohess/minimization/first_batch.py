"""The first batch of a search, with the start evaluated twice; where its values differ, as often as noise needs.

The start is repeated in a call of its own, see `separated`: noise may be the same for all points of a call.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.evaluators.returned import ReturnedValueError
from torch_zerohess.minimization.noise import REPEATED, deviation, differs, is_rounding
from torch_zerohess.minimization.record import Record
from torch_zerohess.search.trust_region import TrustRegion


def evaluate_first_batch(
    points: Tensor, record: Record, search: TrustRegion, make: Callable[[float], TrustRegion], batch: int, most: int
) -> tuple[float, TrustRegion, Tensor, Tensor]:
    """Evaluate the first points and the start again; return the noise, the search, all points and losses.

    If anything raises the search is as before, and the record has what is known: the measurement is made again.

    Args:
        points: that the search asks for [K, n], the start first.
        record: evaluates them, and keeps what is known if that is interrupted.
        search: one that knows nothing, for a loss without noise.
        make: the search for a standard deviation of repeated losses.
        batch: points that are evaluated at once.
        most: evaluations that it may make.
    """
    start = points[:1]
    every = torch.cat([points, start])
    known = record.known - len(every)  # of a measurement that was interrupted
    values = record.values(every)
    if not differs(values[0], values[-1]):
        again = search.losses(values[-1:])  # it may raise: the search is not told before
        tell(search, values[:-1], points, record)
        return 0.0, search, every, torch.cat([search.told, again])
    count = max(min(REPEATED - 2, most + len(record.given) - len(every)), known, 0)
    every = torch.cat([every, start.repeat(count, 1)])
    values = record.values(every)
    losses = search.losses(values)
    if is_rounding(torch.cat([values[:1], values[len(points) :]])):
        tell(search, values[: len(points)], points, record)
        return 0.0, search, every, torch.cat([search.told, losses[len(points) :]])
    again = values[len(points) :]
    if 0 in record.given and len(again) > 2 and not any(differs(one, again[0]) for one in again):
        raise ReturnedValueError(
            f"known must have values of fn, but at x0 it has one that differs from {len(again)} new ones, which agree"
        )
    noise = deviation(torch.cat([losses[:1], losses[len(points) :]]))
    search = make(noise)
    if torch.equal(search.ask(max(batch - 1, 1), limit=len(points)), points):
        search.tell(values[: len(points)])
    else:
        search.tell_at(values, every)
    return noise, search, every, losses


def tell(search: TrustRegion, values: Tensor, points: Tensor, record: Record) -> None:
    """Tell a search the values [K, *out] of the points [K, n] of a request, some of which the caller may have had."""
    if record.opening:
        search.tell_at(values, points)
    else:
        search.tell(values)
