"""Batching rules of operators that are linear in vectors: `torch.vmap` makes one call of them for all elements."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.sampling import extension, kernels
from torch_zerohess.sampling.kernels import Redrawn


def over_vectors(
    linear: Callable[..., Tensor], size: int, vectors: Tensor, samples: Sequence[Any], dims: Sequence[int | None]
) -> tuple[Tensor, int]:
    """Fold a mapped dimension into M where the samples are shared, else into B.

    Args:
        linear: `linear(vectors, *samples)` maps vectors [B, M, ...] to results [B, M, ...].
        size: V, the length of the mapped dimension.
        vectors: [B, M, ...], with the mapped dimension if `dims[0]` is not None.
        samples: tensors that begin with the batch, sigma [n], which is shared by all, and flags.
        dims: the mapped dimension of the vectors, and of each of the samples.

    Returns:
        The results, and their mapped dimension.
    """
    vectors = vectors.expand(size, *vectors.shape) if dims[0] is None else vectors.movedim(dims[0], 0)
    B, M = vectors.shape[1:3]
    if all(dim is None for dim in dims[1:]):
        result = linear(vectors.movedim(0, 1).reshape(B, size * M, -1), *samples)
        return result.reshape(B, size, M, -1), 1
    samples = [_folded(part, dim, size) for part, dim in zip(samples, dims[1:], strict=True)]
    return linear(vectors.reshape(size * B, M, -1), *samples).reshape(size, B, M, -1), 0


def _folded(part: Any, dim: int | None, size: int) -> Any:
    if not isinstance(part, Tensor) or (dim is None and part.dim() == 1):
        return part
    part = part.expand(size, *part.shape) if dim is None else part.movedim(dim, 0)
    return part.flatten(0, 1)


def _project(info: Any, in_dims: Any, u: Tensor, t: Tensor) -> tuple[Tensor, int]:
    return over_vectors(lambda t, u: kernels.project(u, t), info.batch_size, t, (u,), in_dims[::-1])


def _project_drawn(info: Any, in_dims: Any, *inputs: Any) -> tuple[Tensor, int]:
    *recipe, t = inputs
    *dims, dim = in_dims
    return over_vectors(lambda t, *u: kernels.project(Redrawn(*u), t), info.batch_size, t, recipe, (dim, *dims))


def _accumulate(info: Any, in_dims: Any, u: Tensor, a: Tensor, squares: bool) -> tuple[Tensor, int]:
    sums = kernels.accumulate_squares if squares else kernels.accumulate
    return over_vectors(lambda a, u: sums(u, a), info.batch_size, a, (u,), in_dims[1::-1])


def _accumulate_drawn(info: Any, in_dims: Any, *inputs: Any) -> tuple[Tensor, int]:
    *recipe, a, squares = inputs
    *dims, dim, _ = in_dims
    sums = kernels.accumulate_squares if squares else kernels.accumulate
    return over_vectors(lambda a, *u: sums(Redrawn(*u), a), info.batch_size, a, recipe, (dim, *dims))


if extension.available:
    # `torch.func.linearize` records these operators, without the autograd functions that call them.
    for _rule in (_project, _project_drawn, _accumulate, _accumulate_drawn):
        torch.library.register_vmap(f"torch_zerohess::{_rule.__name__[1:]}", _rule)
