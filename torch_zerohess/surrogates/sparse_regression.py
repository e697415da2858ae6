"""Slopes on a known support, their standard errors, and which of them are significant."""

import math

import torch
from torch import Tensor

from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_BLOCK = 1 << 22
"""Elements of A held at a time."""


def slopes(
    u: Tensor, d: Tensor, index: Tensor, used: Tensor, previous: SparseJacobian, ridges: tuple[float, float]
) -> tuple[Tensor, Tensor]:
    """Return slopes [m, keep] on a support and their standard errors, with the previous slopes as the prior."""
    K, m = len(u), len(index)
    rows, values = u.mT.contiguous(), torch.zeros_like(index, dtype=u.dtype)
    errors = torch.zeros_like(values)
    # Rows with few used entries have small systems: the used ones come first.
    width = max(1, int(used.sum(1).max()))
    size = max(1, _BLOCK // (K * width))
    for first in range(0, m, size):
        some = slice(first, first + size)
        own, live = index[some, :width], used[some, :width]
        same = (own[:, :, None] == previous.index[some][:, None]) & (previous.values[some] != 0)[:, None]
        old = (same * previous.values[some][:, None]).sum(2) * live
        A = rows[own] * live[:, :, None]  # [b, width, K]
        prior = torch.where(old != 0, u.new_tensor(ridges[0]), u.new_tensor(ridges[1])) * K * _scale(u, own)
        gram = A @ A.mT
        gram.diagonal(dim1=1, dim2=2).add_(prior)
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(gram))
        target = d[:, some].mT - (A * old[:, :, None]).sum(1)
        change = (inverse @ (A @ target[:, :, None]))[..., 0]
        values[some, :width] = (old + change) * live
        left = target - (A * change[:, :, None]).sum(1)
        own_part = inverse.diagonal(dim1=1, dim2=2)
        spent = ((1.0 - own_part * prior) * live).sum(1).clamp_min(0.0)
        variance = left.square().sum(1) / (K - 1 - spent).clamp_min(1.0)
        shortened = (inverse @ (prior * change)[:, :, None])[..., 0]  # by the ridge
        square = variance[:, None] * own_part.clamp_min(0.0) + shortened.square()
        errors[some, :width] = square.sqrt() * live
    return values, errors


def _scale(u: Tensor, own: Tensor) -> Tensor:
    """Mean squares of the directions along parameters."""
    return u.square().mean(0).clamp_min(torch.finfo(u.dtype).tiny)[own]


def predicted(index: Tensor, values: Tensor, u: Tensor) -> Tensor:
    """Return the changes [K, m] along u [K, n] that slopes predict."""
    K, m, rows = len(u), len(index), u.mT.contiguous()
    live = values != 0
    if not bool(live.any()):
        return u.new_zeros(K, m)
    width = int(live.any(0).nonzero()[-1]) + 1
    size = max(1, _BLOCK // (K * width))
    parts = [
        (rows[index[first : first + size, :width]] * values[first : first + size, :width, None]).sum(1)
        for first in range(0, m, size)
    ]
    return torch.cat(parts).mT.contiguous()


def significant(values: Tensor, errors: Tensor, used: Tensor, K: int, rate: float) -> Tensor:
    """Return the slopes [m, keep] that errors alone do not explain, at a rate of false discoveries.

    Student's t with K - 1 - s degrees of freedom, s entries of the row, becomes a normal number (Wallace 1959). The
    threshold for its probability is by Benjamini and Hochberg (1995).
    """
    nu = (K - 1 - used.sum(1, keepdim=True)).clamp_min(1).double()
    t = values.double() / errors.double().clamp_min(torch.finfo(torch.float64).tiny)
    z = (8 * nu + 1) / (8 * nu + 3) * (nu * torch.log1p(t.square() / nu)).sqrt()
    chance = torch.erfc(z * math.sqrt(0.5))
    ordered = chance[used].sort().values
    fine = (ordered <= rate * torch.arange(1, len(ordered) + 1, device=z.device) / max(len(ordered), 1)).nonzero()
    return chance <= (ordered[fine[-1, 0]] if len(fine) else -1.0)
