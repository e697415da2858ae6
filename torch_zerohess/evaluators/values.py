"""What a black box returned, as a tensor with one value per point."""

import sys
from typing import Any

import torch
from torch import Tensor


def as_tensor(result: Any) -> Tensor:
    """Return what a black box returned as a tensor of real or complex numbers.

    Numbers of Python are float64, alone and in lists, and so are integers and truth values of any kind: counts,
    images of bytes, a loss that is 0 on a plateau.
    """
    if isinstance(result, Tensor):
        return result if result.is_floating_point() or result.is_complex() else result.double()
    try:
        numpy = sys.modules.get("numpy")
        if numpy is not None and hasattr(result, "__array_interface__"):  # of any strides, and types torch may not know
            result = numpy.asarray(result)
            long = result.dtype.kind == "f" and result.dtype.itemsize > 8
            kind = float if long else result.dtype.newbyteorder("=")
            result = numpy.require(result, dtype=kind, requirements="CW")
        leaf = result  # whatever the default dtype of torch
        while isinstance(leaf, (list, tuple)) and len(leaf):
            leaf = leaf[0]
        if numpy is not None and leaf is not result and isinstance(leaf, numpy.ndarray):  # torch takes them one by one
            return as_tensor(numpy.asarray(result))
        # Arrays that are on no GPU go to the CPU, whatever the default device of torch.
        device = None if hasattr(result, "__cuda_array_interface__") else "cpu"
        if isinstance(leaf, float):
            return torch.as_tensor(result, dtype=torch.float64, device=device)
        tensor = torch.as_tensor(result, device=device)
        mixed = isinstance(leaf, int) and tensor.is_floating_point()  # [1, 2.5]
        exact = not (tensor.is_floating_point() or tensor.is_complex())
        return torch.as_tensor(result, dtype=torch.float64, device=device) if mixed or exact else tensor
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(
            f"fn must return a tensor or a NumPy array of numbers, got {type(result).__name__}: {error}"
        ) from error


def checked_values(result: Any, points: Tensor, vectorized: bool = True) -> Tensor:
    """Return values [K, *out] of points [K, n], or raise TypeError or ValueError if they cannot be that."""
    values = as_tensor(result)
    if values.requires_grad:
        raise ValueError("fn returned a tensor that requires grad; a black box has no graph: return it detached")
    if not values.is_floating_point():
        raise TypeError(f"fn must return real numbers, got {values.dtype}: return .real, .abs() or both parts")
    if values.dim() == 0 or values.shape[0] != points.shape[0]:
        raise ValueError(
            f"fn must return one value per point, [{len(points)}, *out] for points "
            f"{list(points.shape)}, got {list(values.shape)}"
            + ("" if vectorized else " from single points")
            + ("; for a function of one point pass vectorized=False" if vectorized else "")
        )
    return values
