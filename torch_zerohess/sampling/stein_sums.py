"""What a likelihood ratio makes of values: coefficients, gradient, Hessian times vector, each in one operator.

The literal references in torch are here too. Coefficients and the gradient of few vectors have the same bits. Sums of n
or K terms in a different order differ by rounding: n + K units in the last place of the sum of magnitudes at most.
"""

import torch
from torch import Tensor

from torch_zerohess.sampling import extension, kernels
from torch_zerohess.sampling.kernels import Samples

_BLOCK = 4096


def total(a: Tensor) -> Tensor:
    """Sum [B, K, P] over K to [B, 1, P] in blocks of fixed size: the bits do not follow the number of threads."""
    whole = a.shape[1] // _BLOCK * _BLOCK
    if whole == 0:
        return a.sum(1, keepdim=True)
    blocks = a[:, :whole].unflatten(1, (-1, _BLOCK)).sum(2).sum(1, keepdim=True)
    return blocks + a[:, whole:].sum(1, keepdim=True)


def coefficients(values: Tensor, share: Tensor | None, K: int, center: bool) -> Tensor:
    """Return (f - baseline) * share, float64 [B, K, P], for values [B, E, *out] of P numbers each.

    The baseline is value K, f(x), where `center`, else zero. share: float64 [B, K, 1], or 1/K where it is None.
    """
    if extension.available and values.is_cpu:
        values = values if values.dtype == torch.float32 else values.double()
        return torch.ops.torch_zerohess.coefficients(values.contiguous(), share, K, center)
    values = values.double().reshape(*values.shape[:2], -1)
    f = values[:, :K] - values[:, K : K + 1] if center else values[:, :K]
    return f * (1.0 / K if share is None else share)


def _compiled(u: Tensor, a: Tensor) -> bool:
    return extension.available and u.is_cpu and a.shape[1] <= kernels.MANY_VECTORS


def gradient(u: Samples, weight: Tensor, a: Tensor, sigma: Tensor | None = None) -> Tensor:
    """Return sum_k a_k w_k u_k, [B, M, n], for u [B, K, n] or its recipe, weight w [B, K] and a [B, M, K].

    sigma: divide by it, float64 [n].
    """
    if isinstance(u, Tensor) and _compiled(u, a):
        return torch.ops.torch_zerohess.weighted_gradient(u.contiguous(), weight.contiguous(), a.contiguous(), sigma)
    sums = kernels.accumulate(u, a * weight[:, None])
    return sums if sigma is None else sums / sigma


def hvp(u: Samples, weight: Tensor, a: Tensor, v: Tensor, sigma: Tensor | None = None) -> Tensor:
    """Return sum_k a_k w_k ((u_k . v) u_k - v), [B, M, n], for v [B, M, n]; the others as in `gradient`.

    sigma: divide v by it, and the result.
    """
    if isinstance(u, Tensor) and _compiled(u, a):
        return torch.ops.torch_zerohess.weighted_hvp(
            u.contiguous(), weight.contiguous(), a.contiguous(), v.contiguous(), sigma
        )
    a, v = a * weight[:, None], v if sigma is None else v / sigma
    sums = kernels.accumulate(u, a * kernels.project(u, v)).addcmul_(total(a.mT).mT, v, value=-1.0)
    return sums if sigma is None else sums / sigma
