"""The Jacobian that samples determine, by least squares on all parameters: for few parameters, in dense rows.

Rows with few entries are what `sparse_fit` looks for. Where every output depends on every parameter it misses weak
entries, and a loss that is minimised with them missing is not minimal. Where there are more samples than parameters,
plain least squares misses nothing. Samples that are left out, one at a time, tell which of the two predicts better.
"""

import torch
from torch import Tensor

from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_SPARE = 2
"""Samples beyond the number of parameters, at least: the constant takes one of them."""
_HELD = 1 << 25
"""Entries of a Jacobian, at most."""
_LEVERAGE = 1e-6
"""Least share of a sample that the others do not determine: a sample without such a share does not count."""


def is_determined(n: int, samples: int, outputs: int) -> bool:
    """Whether so many samples determine rows of n entries, and so many outputs are not too many for dense rows."""
    return samples >= n + _SPARE and n * outputs <= _HELD


def better_determined(sparse: SparseJacobian, u: Tensor, changes: Tensor) -> SparseJacobian:
    """Return the least-squares Jacobian if it predicts left-out samples better than the sparse one, or else that one.

    Args:
        sparse: fitted to these samples; the result has its type.
        u: directions [K, n].
        changes: of the outputs along them [K, m]; a constant is part of the fit.
    """
    (samples, n), outputs = u.shape, changes.shape[1]
    if not is_determined(n, samples, outputs):
        return sparse
    u, d = u.double() - u.double().mean(0), changes.double() - changes.double().mean(0)
    left, singular, right = torch.linalg.svd(u, full_matrices=False)
    if not float(singular[-1]) > torch.finfo(torch.float32).eps * float(singular[0]):
        return sparse
    along = left.mT @ d
    told = (1.0 - 1.0 / samples - left.square().sum(1)).clamp_min(_LEVERAGE)
    missed = float(((d - left @ along) / told[:, None]).square().sum())
    total = float((d / (1.0 - 1.0 / samples)).square().sum())
    if not missed < (1.0 - sparse.explained) * total:
        return sparse
    values = (right.mT @ (along / singular[:, None])).mT
    variance = (d - left @ along).square().sum(0) / max(samples - n - 1, 1)
    errors = (variance[:, None] * (right.mT / singular).square().sum(1)).sqrt()
    return SparseJacobian(
        torch.arange(n, device=u.device).expand(outputs, n).contiguous(),
        values.to(sparse.values),
        errors.to(sparse.values),
        n,
        sparse.shape,
        explained=1.0 - missed / total,
        explained_dense=sparse.explained_dense,
    )
