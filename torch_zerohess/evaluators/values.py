"""What a black box returned, as a tensor with one value per point."""

from typing import Any

import torch
from torch import Tensor


def as_tensor(result: Any) -> Tensor:
    """Return what a black box returned as a tensor. Numbers of Python are float64, alone and in lists."""
    try:
        leaf = result  # whatever the default dtype of torch
        while isinstance(leaf, (list, tuple)) and len(leaf):
            leaf = leaf[0]
        if isinstance(leaf, float):
            return torch.as_tensor(result, dtype=torch.float64)
        tensor = torch.as_tensor(result)
        mixed = isinstance(leaf, int) and tensor.is_floating_point()  # [1, 2.5]
        return torch.as_tensor(result, dtype=torch.float64) if mixed else tensor
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"fn must return a tensor or a NumPy array, got {type(result).__name__}") from error


def checked_values(result: Any, points: Tensor, vectorized: bool = True) -> Tensor:
    """Return values [K, *out] of points [K, n], or raise TypeError or ValueError if they cannot be that."""
    values = as_tensor(result)
    if values.requires_grad:
        raise ValueError("fn returned a tensor that requires grad; a black box has no graph: return it detached")
    if not values.is_floating_point():
        raise TypeError(f"fn must return real floating-point values, got {values.dtype}: convert, e.g. .float()")
    if values.dim() == 0 or len(values) != len(points):
        raise ValueError(
            f"fn must return one value per point, [{len(points)}, *out] for points "
            f"{list(points.shape)}, got {list(values.shape)}"
            + ("" if vectorized else " from single points")
            + ("; for a function of one point pass vectorized=False" if vectorized else "")
        )
    return values
