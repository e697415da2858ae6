"""Products with a sparse matrix and its transpose, differentiable to every order."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_zerohess.sampling import extension
from torch_zerohess.wrappers import readable

_COMPILED = {torch.float32, torch.float64}
"""Types of the C++ operator, which is for one vector: embedding_bag would take three times as long."""


class SparseRows(NamedTuple):
    """The entries of a matrix, row after row."""

    column: Tensor
    """Of each entry, int64 [entries]."""
    first: Tensor
    """Where each row begins, int64 [rows]."""
    values: Tensor
    """[entries]"""

    @classmethod
    def of(cls, row: Tensor, column: Tensor, values: Tensor, rows: int) -> "SparseRows":
        """Return entries in any order, in order."""
        row, order = row.sort(stable=True)
        counts = torch.bincount(row, minlength=rows)
        return cls(column[order], counts.cumsum(0) - counts, values[order])

    def times(self, vectors: Tensor) -> Tensor:
        """Return the products [K, rows] with vectors [K, columns], without a graph."""
        compiled = extension.available and vectors.is_cpu and {vectors.dtype, self.values.dtype} <= _COMPILED
        if compiled and len(vectors) == 1:
            product = torch.ops.torch_zerohess.sparse_times(*self, vectors[0].contiguous())
            return product[None]
        sums = nn.functional.embedding_bag(
            self.column, vectors.mT.contiguous(), self.first, mode="sum", per_sample_weights=self.values.to(vectors)
        )
        return sums.mT

    def times_in_graph(self, vectors: Tensor) -> Tensor:
        """Return the same by operations that torch differentiates."""
        entry = torch.arange(len(self.column), device=self.column.device)
        row = torch.searchsorted(self.first, entry, right=True) - 1
        terms = vectors[:, self.column] * self.values.to(vectors)
        return vectors.new_zeros(len(vectors), len(self.first)).index_add(1, row, terms)


def product(matrix: SparseRows, transposed: SparseRows, vectors: Tensor) -> Tensor:
    """Return the products [K, rows] of a matrix, given with its transpose, and vectors [K, columns]."""
    if torch.compiler.is_compiling():
        return matrix.times_in_graph(vectors)  # Dynamo traces no function with a custom jvp
    result: Tensor = _Product.apply(vectors, *matrix, *transposed)
    return result


class _Product(torch.autograd.Function):
    """`apply(vectors, *matrix, *transposed)`: a linear map, whose derivatives are products with either matrix."""

    @staticmethod
    def forward(vectors: Tensor, *parts: Tensor) -> Tensor:
        return SparseRows(*parts[:3]).times(vectors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.save_for_backward(*inputs[1:])
        ctx.save_for_forward(*inputs[1:])

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        parts = ctx.saved_tensors
        if torch.is_grad_enabled() and not readable(gradient):  # `is_grads_batched` takes the graph from functions
            return SparseRows(*parts[3:]).times_in_graph(gradient), *(None for _ in parts)
        return _Product.apply(gradient, *parts[3:], *parts[:3]), *(None for _ in parts)

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: Any) -> Tensor:
        result: Tensor = _Product.apply(tangent, *ctx.saved_tensors)
        return result

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], vectors: Tensor, *parts: Tensor) -> tuple[Tensor, int]:
        """Fold the mapped dimension into K; matrices are not mapped over."""
        vectors = vectors.movedim(in_dims[0], 0)
        return _Product.apply(vectors.flatten(0, 1), *parts).unflatten(0, vectors.shape[:2]), 0
