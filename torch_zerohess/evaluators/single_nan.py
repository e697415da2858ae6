"""A single NaN in place of an output [*out]: the point has no value, whatever the shape of an output is."""

import math
import sys
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor


def without_output(values: Tensor) -> bool:
    """Whether values [K, ...] are a single NaN for each point."""
    return values.ndim == 1 and bool(values.isnan().all())


def filled(values: Tensor, like: Tensor) -> Tensor:
    """Return NaN [K, *out] for values [K] that are a single NaN each, and other values as they are.

    like: has the type of other values, and their shape [..., *out] after its first dimension.
    """
    if like.ndim < 2 or not without_output(values):
        return values
    return like.new_full((len(values), *like.shape[1:]), torch.nan, device=values.device)


def alike(parts: Sequence[Tensor]) -> list[Tensor]:
    """Return parts [k, *out] with NaN in the shape of the others where a part is a single NaN for each point."""
    like = next((one for one in parts if one.ndim > 1), None)
    return [*parts] if like is None else [filled(one, like) for one in parts]


def filled_rows(rows: list[Any] | tuple[Any, ...]) -> list[Any] | tuple[Any, ...]:
    """Return a list of outputs, each a tensor, an array or a list, with NaN in their shape where one is a single NaN.

    A list of numbers is returned as it is.
    """
    like = next((one for one in rows if isinstance(one, (list, tuple)) or len(getattr(one, "shape", ())) > 0), None)
    if like is None or not any(_is_nan(one) for one in rows):
        return rows
    missing = _missing(like)
    return [missing if _is_nan(one) else one for one in rows]


def _is_nan(one: Any) -> bool:
    """Whether this is a single NaN: of Python, NumPy or torch."""
    shape = () if isinstance(one, float) else getattr(one, "shape", None)
    return shape is not None and not len(shape) and bool(one != one)


def _missing(like: Any) -> Any:
    """Return NaN in the shape of an output."""
    if isinstance(like, Tensor):
        return torch.full_like(like, torch.nan, dtype=like.dtype if like.is_floating_point() else torch.float64)
    if isinstance(like, (list, tuple)):
        return [_missing(one) for one in like]
    numpy: Any = sys.modules.get("numpy")
    if numpy is not None and isinstance(like, numpy.ndarray):
        return numpy.full(like.shape, numpy.nan, like.dtype if like.dtype.kind == "f" else float)
    return math.nan
