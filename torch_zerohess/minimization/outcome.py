"""What a search returns: the best point, the function around it, and how it has ended."""

import torch
from torch import Tensor

from torch_zerohess.minimization.derivatives import Derivatives, is_elsewhere, is_flat, quadratic_at
from torch_zerohess.minimization.measured_derivatives import measured
from torch_zerohess.minimization.minimum import Minimum, Status
from torch_zerohess.minimization.running import Running
from torch_zerohess.minimization.stopping import status_of
from torch_zerohess.minimization.wording import NARROW, worded

_NEAR = 3.0
"""Distance between x and the first point along a parameter, in units of sigma, that a search of a box should exceed."""
_SHORT = "the steps became short at x, which may be no minimum"


def outcome(running: Running, status: Status, message: str) -> Minimum:
    """Return the result of a search that has ended with a status, or so far, and what the message says of it."""
    search = running.search
    (x, value, error), (points, losses) = running.best, running.record.told
    own = running.record.own
    around = quadratic_at(x, search, points, losses, running.noise or 0.0, measured(running, x))
    begun = search.evaluations > 0  # a start whose value it cannot take says nothing of sigma
    equal = running.evaluations if begun and running.record.flat and len(search.unit) < running.evaluations else 0
    doubt = "" if running.noise else running.doubt or _doubt(running, around)
    status = "stalled" if status == "solved" and doubt == _SHORT else status
    arrived = status_of(running, arrived=search.solved) == "solved" and not doubt
    success = status in ("target", "solved") or arrived
    at = (points[own] == x).all(1).nonzero()
    lower, upper = search.bounds
    at_bounds = (x == lower) | (x == upper)
    return Minimum(
        x=x,
        value=value,
        **around._asdict(),
        at_bounds=at_bounds,
        evaluations=running.evaluations,
        points=points[own],
        values=losses[own],
        message=worded(
            message,
            status,
            equal,
            doubt,
            search.untouched,
            arrived=search.solved,
            success=success,
            flat=not running.noise and search.untouched is None and is_flat(around, search.unit),
            measuring=running.needed_for_noise,
            failed=int((~torch.isfinite(losses[own])).sum()),
            same_outputs=running.record.same_outputs,
            found=int(at[0]) + 1 if len(at) and not running.noise else 0,
            evaluations=running.evaluations,
            at_bounds=at_bounds,
            narrow=_narrow(running, points, x),
        ),
        engine=search.engine,
        success=success,
        status=status,
        value_error=error,
        noise=running.noise or 0.0,
    )


def _doubt(running: Running, around: Derivatives) -> str:
    """Return why an arrival of short steps may be none; empty if rounds agree, or if a quadratic confirms it."""
    search = running.search
    if search.polished or search.agreed > 1 or not search.solved or not is_elsewhere(around, running.best.x, search):
        return ""
    return _SHORT


def _narrow(running: Running, points: Tensor, x: Tensor) -> Tensor:
    """Return which parameters have a sigma far too small for their bounds, and have hardly moved: bools [n].

    Args:
        running: the search.
        points: evaluations [P, n], the first of them x0.
        x: [n].
    """
    (lower, upper), unit = running.search.bounds, running.search.unit
    width = upper.to(unit) - lower.to(unit)
    near = (x - points[:1]).abs().amax(0).to(unit) <= _NEAR * unit if len(points) else width < 0.0
    return (width < torch.inf) & (unit < NARROW * width) & near
