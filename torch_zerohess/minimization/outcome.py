"""What a search returns: the best point, the function around it, and how it has ended."""

import torch

from torch_zerohess.minimization.derivatives import is_flat, quadratic_at
from torch_zerohess.minimization.measured_derivatives import measured
from torch_zerohess.minimization.minimum import Minimum, Status
from torch_zerohess.minimization.running import Running
from torch_zerohess.minimization.stopping import status_of
from torch_zerohess.minimization.wording import worded


def outcome(running: Running, status: Status, message: str) -> Minimum:
    """Return the result of a search that has ended with a status, or so far, and what the message says of it."""
    search = running.search
    (x, value, error), (points, losses) = running.best, running.record.told
    own = running.record.own
    around = quadratic_at(x, search, points, losses, running.noise or 0.0, measured(running, x))
    begun = search.evaluations > 0  # a start whose value it cannot take says nothing of sigma
    equal = running.evaluations if begun and running.record.flat and len(search.unit) < running.evaluations else 0
    success = status in ("target", "solved") or status_of(running, arrived=search.solved) == "solved"
    return Minimum(
        x=x,
        value=value,
        **around._asdict(),
        evaluations=running.evaluations,
        points=points[own],
        values=losses[own],
        message=worded(
            message,
            status,
            equal,
            "" if running.noise else running.doubt,
            search.untouched,
            arrived=search.solved,
            success=success,
            flat=not running.noise and search.untouched is None and is_flat(around, search.unit),
            measuring=running.needed_for_noise,
            failed=int((~torch.isfinite(losses[own])).sum()),
            same_outputs=running.record.same_outputs,
        ),
        engine=search.engine,
        success=success,
        status=status,
        value_error=error,
        noise=running.noise or 0.0,
    )
