"""Values that were known when a call failed: the exception carries them to whoever made the call."""

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.evaluators.single_nan import alike
from torch_zerohess.evaluators.values import checked_values


@dataclass(frozen=True, eq=False)
class Finished:
    """Values of some of the points [K, n] of a call, by number."""

    points: Tensor
    values: Mapping[int, Tensor]


def keep_finished(error: BaseException, points: Tensor, values: Mapping[int, Tensor]) -> None:
    """Let an exception of the call with `points` [K, n] carry the values [*out] that are known, by number."""
    with contextlib.suppress(Exception):  # a frozen dataclass takes no attributes
        error.finished = Finished(points, values)  # type: ignore[attr-defined]


def finished_values(error: BaseException, points: Tensor) -> tuple[list[int], Tensor]:
    """Return the numbers of the points whose values are known, in order, and these values [k, *out].

    None are known if the exception is of a call with other points: a black box may itself make such calls. `points` is
    the tensor of the call, not an equal one.
    """
    found = getattr(error, "finished", None)
    if isinstance(found, Finished) and found.points is points and found.values:
        numbers = sorted(found.values)
        try:
            values = torch.cat(alike([found.values[k][None] for k in numbers]))
            return numbers, checked_values(values, points[numbers]).to(points.device, copy=True)
        except (TypeError, ValueError, RuntimeError):  # of different shapes, or no numbers: they are of no use
            pass
    return [], points.new_empty(0)
