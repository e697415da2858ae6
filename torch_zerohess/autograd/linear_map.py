"""The linear map between parameters and samples as an autograd function: all that autograd must know about sampling.

With perturbations U [K, n], an estimate depends on x only through U d, d = (x - x_0) / sigma. Its derivatives need
U^T a. Both maps are linear and each is the transpose of the other. So one function serves both: it calls itself in
`backward` and `jvp`, and has derivatives of every order, in every mode, batched or not. U is stored or drawn again.
"""

from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.sampling import kernels
from torch_zerohess.sampling.batching import over_vectors
from torch_zerohess.sampling.kernels import Redrawn, Samples


def project(u: Samples, t: Tensor, *, zero: bool = False) -> Tensor:
    """Return U t, [B, M, K], for u [B, K, n] and t [B, M, n]; `zero` promises that t is zero in value."""
    if torch.compiler.is_compiling() and isinstance(u, Tensor):
        return product(t, u)  # Dynamo traces no function with a custom jvp; plain operations need none
    result: Tensor = _LinearMap.apply(t, False, zero, *_flat(u))
    return result


def product(a: Tensor, b: Tensor) -> Tensor:
    """Return a b^T, [B, M, K], for a [B, M, n] and b [B, K, n]."""
    if torch.compiler.is_compiling() and transforms.forward_mode_active():
        # torch (tried: 2.15) takes no derivative of the tangent of a batched product where it compiles.
        return (a[:, :, None] * b[:, None]).sum(3)
    return a @ b.mT


def _flat(u: Samples) -> tuple[Any, ...]:
    return (u,) if isinstance(u, Tensor) else tuple(u)


def _unflat(parts: tuple[Any, ...]) -> Samples:
    return parts[0] if len(parts) == 1 else Redrawn(*parts)


def _in_graph(u: Samples, vectors: Tensor, transposed: bool) -> Tensor:
    """Return U vectors, or U^T vectors where `transposed`, by operations that torch differentiates."""
    if isinstance(u, Redrawn):
        u = u.perturbations()
    return vectors @ (u if transposed else u.mT)


class _LinearMap(torch.autograd.Function):
    """`apply(vectors, transposed, zero, *samples)`: U vectors, or U^T vectors where `transposed`."""

    @staticmethod
    def forward(vectors: Tensor, transposed: bool, zero: bool, *parts: Any) -> Tensor:
        u = _unflat(parts)
        if zero or transforms.is_symbolic_zero(vectors):
            K, n = u.shape[1:] if isinstance(u, Tensor) else (u.K, u.x.shape[1])
            return torch.zeros(*vectors.shape[:2], n if transposed else K, dtype=vectors.dtype, device=vectors.device)
        return kernels.accumulate(u, vectors) if transposed else kernels.project(u, vectors)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.transposed = inputs[1]
        tensors = [part for part in inputs[3:] if isinstance(part, Tensor)]
        ctx.flags = [part for part in inputs[3:] if not isinstance(part, Tensor)]
        ctx.save_for_backward(*tensors)
        ctx.save_for_forward(*tensors)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Any, ...]:
        parts = (*ctx.saved_tensors, *ctx.flags)
        if transforms.mapped_in_graph(gradient):
            result = _in_graph(_unflat(parts), gradient, not ctx.transposed)
        else:
            result = _LinearMap.apply(gradient, not ctx.transposed, False, *parts)
        return (result, None, None, *(None for _ in parts))

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: Any) -> Tensor:
        result: Tensor = _LinearMap.apply(tangent, ctx.transposed, False, *ctx.saved_tensors, *ctx.flags)
        return result

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], vectors: Tensor, transposed: bool, zero: bool, *parts: Any) -> Any:
        def linear(vectors: Tensor, *parts: Any) -> Tensor:
            result: Tensor = _LinearMap.apply(vectors, transposed, zero, *parts)
            return result

        return over_vectors(linear, info.batch_size, vectors, parts, (in_dims[0], *in_dims[3:]))
