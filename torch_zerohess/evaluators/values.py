"""What a black box returned, as a tensor with one value per point."""

import itertools
import sys
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.evaluators.returned import ReturnedTypeError, ReturnedValueError
from torch_zerohess.evaluators.single_nan import filled_rows

_SHOWN = 8
"""Keys of a dictionary that a message names."""


def stacked(rows: Any) -> Any:
    """Return a list of tensors, or of arrays of NumPy, as one of them, and anything else as it is.

    Raises ValueError for rows of different shapes.
    """
    if not isinstance(rows, (list, tuple)):
        return rows
    rows = [one if isinstance(one, (int, float)) else _as_array(one) for one in rows]
    rows = filled_rows(rows)
    kind = type(leaf(rows))
    numpy: Any = sys.modules.get("numpy")
    arrays = numpy is not None and issubclass(kind, numpy.ndarray)
    if not (arrays or issubclass(kind, Tensor)):
        return rows
    parts = [stacked(one) for one in rows]
    if not all(isinstance(one, numpy.ndarray if arrays else Tensor) for one in parts):
        return rows
    for k, one in enumerate(parts):
        if one.shape != parts[0].shape:
            raise ReturnedValueError(
                f"rows must have one shape, got {[*one.shape]} for row {k} and {[*parts[0].shape]} before"
            )
    return _known(numpy.asarray([_unmasked(one) for one in parts])) if arrays else torch.stack(parts)


def _as_array(result: Any) -> Any:
    """Return a picture of Pillow, or a table of pandas, as an array of NumPy, and anything else as it is."""
    numpy: Any = sys.modules.get("numpy")
    if numpy is None or isinstance(result, (Tensor, numpy.ndarray, numpy.generic)):
        return result
    # Arrays of JAX have both: torch takes them where they are.
    on_host = hasattr(result, "__array__") and not hasattr(result, "__dlpack__")
    return numpy.asarray(result) if on_host or hasattr(result, "__array_interface__") else result


def _unmasked(array: Any) -> Any:
    """Return an array of NumPy with NaN where it is masked."""
    numpy = sys.modules["numpy"]
    if not isinstance(array, numpy.ma.MaskedArray):
        return numpy.asarray(array)
    return (array if array.dtype.kind in "fc" else array.astype(float)).filled(numpy.nan)


def _known(array: Any) -> Any:
    """Return an array of NumPy that torch can share: of its own byte order, types and strides."""
    numpy = sys.modules["numpy"]
    long = array.dtype.kind == "f" and array.dtype.itemsize > 8
    array = array.copy() if min(array.strides, default=0) < 0 else array  # also of a length of 1
    return numpy.require(array, dtype=float if long else array.dtype.newbyteorder("="), requirements="CW")


def leaf(result: Any) -> Any:
    """Return the first element of a list of lists."""
    while isinstance(result, (list, tuple)) and len(result):
        result = result[0]
    return result


def as_tensor(result: Any) -> Tensor:
    """Return what a black box returned as a tensor of real or complex numbers.

    A list of tensors, arrays or pictures of one shape is stacked; a single NaN in it stands for a whole one. Numbers of
    Python are float64, alone and in lists, and so are integers and truth values of any kind: counts, images of bytes, a
    loss that is 0 on a plateau. Masked entries of a NumPy array are NaN. Sparse tensors are filled.
    """
    if isinstance(result, Mapping):
        names = ", ".join(map(repr, itertools.islice(result, _SHOWN))) + (", ..." if len(result) > _SHOWN else "")
        raise ReturnedTypeError(
            f"fn must return one tensor [K, *out], got a {type(result).__name__} of {names or 'nothing'}: return one "
            "of its values, or join them along dimension 1"
        )
    try:
        result = stacked(result)
        if isinstance(result, Tensor):
            result = result if result.layout is torch.strided else result.to_dense()
            return result if result.is_floating_point() or result.is_complex() else result.double()
        result = _as_array(result)
        if hasattr(result, "__array_interface__"):
            result = _known(_unmasked(result))
        first = leaf(result)
        # Arrays that are on no GPU go to the CPU, whatever the default device of torch.
        device = None if hasattr(result, "__cuda_array_interface__") else "cpu"
        if isinstance(first, (int, float)):  # whatever the default dtype of torch, and above int64, too
            return torch.as_tensor(result, dtype=torch.float64, device=device)
        tensor = torch.as_tensor(result, device=device)
        exact = not (tensor.is_floating_point() or tensor.is_complex())
        return torch.as_tensor(result, dtype=torch.float64, device=device) if exact else tensor
    except (TypeError, ValueError, RuntimeError, OverflowError) as error:
        raise ReturnedTypeError(
            f"fn must return a tensor or a NumPy array of numbers, got {type(result).__name__}: {error}"
        ) from error


def checked_values(result: Any, points: Tensor, vectorized: bool = True) -> Tensor:
    """Return values [K, *out] of points [K, n], or raise TypeError or ValueError if they cannot be that.

    A batch whose values are a tuple of tensors is several results, as `(image, info)`, and no list of points.
    """
    if vectorized and isinstance(result, tuple) and any(getattr(one, "ndim", 0) > 0 for one in result):
        raise ReturnedTypeError(
            f"fn must return one tensor [K, *out], got a tuple of {len(result)}: return one of them, or join them "
            "along dimension 1" + ("; one value per point may be a list" if len(result) == len(points) else "")
        )
    values = as_tensor(result)
    if values.requires_grad:
        raise ReturnedValueError(
            "fn returned a tensor that requires grad; a black box has no graph: return it detached"
        )
    if not values.is_floating_point():
        raise ReturnedTypeError(f"fn must return real numbers, got {values.dtype}: return .real, .abs() or both parts")
    if values.dim() == 0 or values.shape[0] != points.shape[0]:
        raise ReturnedValueError(
            f"fn must return one value per point, [{len(points)}, *out] for points "
            f"{list(points.shape)}, got {list(values.shape)}"
            + ("" if vectorized else " from single points")
            + ("; for a function of one point pass vectorized=False" if vectorized else "")
        )
    return values
