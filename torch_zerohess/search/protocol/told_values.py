"""The values that a caller tells about the points of a search: checked, and kept until all of them are known."""

import math
import reprlib
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_integer
from torch_zerohess.estimation.inputs import times_changed
from torch_zerohess.evaluators.returned import ReturnedTypeError, ReturnedValueError
from torch_zerohess.evaluators.single_nan import alike, filled, without_output
from torch_zerohess.evaluators.values import as_tensor
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated

_LARGEST = 1e305
"""Magnitude of losses beyond which models overflow: higher ones count as this one, lower ones as not finite."""
_LARGEST_OUTPUT = 1e100
"""Magnitude of numbers of an output, from which on they count as not finite: models square them."""


def converted(values: Any, device: torch.device) -> Tensor:
    """Return what a caller told as float64, detached; TypeError if it is no tensor, array or list of numbers."""
    try:
        values = as_tensor(values)
        if values.is_complex():
            raise TypeError("they are complex")
        values = torch.as_tensor(values, dtype=torch.float64, device=device)
    except (TypeError, ValueError, RuntimeError) as error:
        raise ReturnedTypeError(
            f"values must be a tensor, an array or numbers, got {reprlib.repr(values)}: {error}"
        ) from error
    found: Tensor = values.detach()
    return found


def as_evaluated(
    values: Tensor, points: Tensor, loss: Callable[[Tensor], Tensor] | None, shape: torch.Size
) -> Evaluated:
    """Return the values told about points [K, n] as losses and outputs.

    values: [K], or [K, *out] if there is a loss, float64.
    shape: of earlier outputs [*out]; empty if there are none.

    Raises ValueError or TypeError for values, or losses of them, of a wrong shape or type.
    """
    if loss is None and values.shape == (len(points), 1):
        values = values[:, 0]
    if values.ndim < 1 or len(values) != len(points) or (loss is None and values.ndim != 1):
        wanted = f"[{len(points)}]" if loss is None else f"[{len(points)}, *out]"
        raise ReturnedValueError(f"values must have shape {wanted}, one per point asked for, got {list(values.shape)}")
    if loss is None:
        return Evaluated(points, values)
    values = filled(values, values.new_empty(0, *shape))
    if shape and values.shape[1:] != shape:
        raise ReturnedValueError(f"values must have outputs {list(shape)} as before, got {list(values.shape[1:])}")
    if without_output(values):  # a loss need not take a single NaN in place of an output
        return Evaluated(points, values, values[:, None], values.shape[1:])
    before = times_changed(values)
    with torch.no_grad():
        losses = [loss(one) for one in values]
    if times_changed(values) != before:
        raise ReturnedValueError("loss must not change the output that it is given, which is kept: use a copy of it")
    for one in losses:
        _check_loss(one, list(values.shape[1:]))
    return Evaluated(
        points,
        torch.stack([one.double().reshape(()) for one in losses]),
        values.reshape(len(values), -1),
        values.shape[1:],
    )


def _check_loss(loss: Any, shape: list[int]) -> None:
    """Raise TypeError or ValueError for what is no loss of an output of this shape."""
    if not isinstance(loss, Tensor):
        raise ReturnedTypeError(
            f"loss must return a tensor, which torch differentiates, got {type(loss).__name__} for one output of shape "
            f"{shape}: a loss that torch cannot compute belongs in the black box, which then returns the loss"
        )
    if loss.numel() != 1:
        raise ReturnedValueError(
            f"loss must return a scalar, got shape {list(loss.shape)} for one output of shape {shape}"
        )
    if loss.is_complex():
        raise ReturnedTypeError(f"loss must return a real number, got {loss.dtype}: return .real or .abs()")


def joined(early: dict[int, Tensor], values: Tensor, which: Sequence[int], count: int) -> dict[int, Tensor]:
    """Return the values of points by number, those known early and further ones [k, *out] of the points `which` [k].

    Raises ValueError for a number that is not one of `count` points or is known, or for values of another shape;
    TypeError for what is no list of numbers.
    """
    if not hasattr(which, "__iter__") or getattr(which, "ndim", 1) == 0:
        raise TypeError(f"which must be a list of numbers of points, as [0], got {which!r}")
    numbers = [checked_integer("which", one) for one in which]
    for k, one in enumerate(numbers):
        if not 0 <= one < count or one in early or one in numbers[:k]:
            missing = [other for other in range(count) if other not in early]
            raise ValueError(f"which must be some of the points whose values are missing, {missing}, got {numbers}")
    if values.ndim < 1 or len(values) != len(numbers):
        raise ReturnedValueError(
            f"values must have one per point in which, [{len(numbers)}, *out], got {list(values.shape)}"
        )
    found = alike([*(value[None] for value in early.values()), values])
    for other in found:
        if other.shape[1:] != found[-1].shape[1:]:
            raise ReturnedValueError(
                f"values must have outputs {list(other.shape[1:])} as before, got {list(values.shape[1:])}"
            )
    return dict(zip([*early, *numbers], (one.clone() for part in found for one in part), strict=True))


def moderate(told: Evaluated) -> Evaluated:
    """Return what was told, without numbers so large that models overflow."""
    losses, outputs = told.losses, told.outputs
    losses = torch.where(losses < -_LARGEST, -math.inf, losses)
    losses = torch.where(torch.isfinite(losses), losses.clamp(max=_LARGEST), losses)
    if outputs is not None and bool((outputs.abs() > _LARGEST_OUTPUT).any()):
        outputs = torch.where(outputs.abs() > _LARGEST_OUTPUT, math.inf, outputs)
    return replace(told, losses=losses, outputs=outputs)


def check_start(start: Evaluated) -> None:
    """Raise ValueError if the first point, which is the start, has no value that models can take."""
    loss, start = float(start.losses[0]), moderate(start)
    if -math.inf < loss < -_LARGEST:
        raise ReturnedValueError(f"the loss at the start x0 is {loss}, below {-_LARGEST}: scale the loss")
    if _LARGEST < loss < math.inf:
        raise ReturnedValueError(
            f"the loss at the start x0 is {loss}, above {_LARGEST}: scale the loss, or start where it is no penalty"
        )
    if bool(start.finite[0]):
        return
    if start.outputs is not None and not math.isfinite(loss) and bool(torch.isfinite(start.outputs[0]).all()):
        missing = ": if data are missing, let it leave them out, as (y - data)[torch.isfinite(data)].square().sum()"
        told = missing if math.isnan(loss) else ""
        raise ReturnedValueError(f"loss is {loss} at the start x0, although the output there is finite{told}")
    if start.outputs is None or not math.isfinite(loss):
        raise ReturnedValueError(f"the black box is not finite at the start x0: {loss}; choose another x0")
    count = int((~torch.isfinite(start.outputs[0])).sum())
    raise ReturnedValueError(
        f"{count} of {start.outputs.shape[1]} numbers of the output at the start x0 are not finite, or beyond "
        f"{_LARGEST_OUTPUT}: the search models every number, also those that the loss ignores; return moderate ones"
    )


def check_range(search: str, changes: Tensor) -> None:
    """Raise ValueError for changes of outputs over sigma that float32 cannot hold; `search` says who computes in it."""
    if not in_range(changes):
        raise ReturnedValueError(
            f"{search} computes in float32, got outputs whose largest change over sigma is "
            f"{float(changes.abs().max()):g}: return them in other units, so that it is near 1"
        )


def in_range(changes: Tensor) -> bool:
    """Whether the largest of these numbers is a normal number in float32, or all are 0."""
    largest, limits = float(changes.abs().max()), torch.finfo(torch.float32)
    return largest == 0.0 or limits.tiny <= largest <= limits.max
