"""Several tensors as one vector: parameters, gradients, outputs."""

import functools
from collections.abc import Sequence

import torch
from torch import Tensor


def flattened(tensors: Sequence[Tensor]) -> Tensor:
    """Return the numbers of tensors, N in all, one after the other: [N], dense.

    The gradients of some embeddings are sparse.
    """
    return torch.cat([(one.to_dense() if one.is_sparse else one).reshape(-1) for one in tensors])


def widest_type(tensors: Sequence[Tensor]) -> torch.dtype:
    """Return the type of their numbers as one vector."""
    return functools.reduce(torch.promote_types, (one.dtype for one in tensors))


def split_like(vector: Tensor, tensors: Sequence[Tensor]) -> list[Tensor]:
    """Return the parts of a vector [N] in the shapes of tensors, N numbers in all."""
    parts = vector.split([one.numel() for one in tensors])
    return [part.view_as(one) for part, one in zip(parts, tensors, strict=True)]


def add_parts(tensors: Sequence[Tensor], vector: Tensor) -> None:
    """Add the parts of a vector [N] to tensors, N numbers in all, in place and in their types.

    Autocast keeps copies of parameters in lower precision. It forgets them here and in `overwrite`.
    """
    with torch.no_grad():
        for one, part in zip(tensors, split_like(vector, tensors), strict=True):
            one.add_(part.to(one.dtype))
    torch.clear_autocast_cache()


def overwrite(tensors: Sequence[Tensor], values: Sequence[Tensor]) -> None:
    """Copy values into tensors of the same shapes."""
    with torch.no_grad():
        for one, value in zip(tensors, values, strict=True):
            one.copy_(value)
    torch.clear_autocast_cache()
