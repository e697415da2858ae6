"""The parameters that some output depends on for certain, by sparse Jacobians that are fitted one after the other.

A selection at a rate of false discoveries has false entries. Two tests tell the parameters that some output depends on.
An entry of a fit is certain if its chance is small even among all pairs of an output and a parameter (Bonferroni). And
new samples test each parameter j with the slopes J of the fit before. The Jacobian without parameter j leaves e of the
changes, [K, m]. If no output depends on j, the sums c = sum_i J_ij e_i are independent of the directions u_j, [K]. So
their correlation has a known distribution, whatever J is. The sum over batches of these numbers, each standard normal
by chance, grows where the slopes are true.

Batch b has the share 1 / (b (b + 1)) of the level. These shares sum to 1, so the level is one of all batches together.
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.sparse_regression import chances, normal_from_t

_LEVEL = 5e-3
"""Probability, for each of the two tests, that any of the parameters that no output depends on is ever certain."""

_ROUNDING = 1e-6
"""Sums below this share of what parameter j adds to them are rounding."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the batches so far tell about every parameter."""

    certain: Tensor
    """Whether some output depends on it, bools [n]."""
    sums: Tensor
    """Of the normal numbers of the tests by new samples, float64 [n]."""
    batches: int = 0

    @classmethod
    def none(cls, n: int, device: torch.device) -> "Evidence":
        """Return the evidence before the first batch."""
        zeros = torch.zeros(n, dtype=torch.float64, device=device)
        return cls(zeros > 0, zeros)

    def with_batch(self, fitted: SparseJacobian, before: SparseJacobian | None, u: Tensor, d: Tensor) -> "Evidence":
        """Add a batch of directions u [K, n] and changes d [K, m].

        fitted: to this batch and the ones before it. Its standard errors must be those of samples of one variance,
            which hold where an output does not depend on a parameter.
        before: the fit to the ones before it; None for the first batch.
        """
        if before is None:
            used = fitted.found
            chance = chances(fitted.values, fitted.standard_error, used, len(u))
            certain = self.certain.clone()
            certain[fitted.index[used & (chance <= _LEVEL / (len(used) * fitted.n))]] = True
            return replace(self, certain=certain)
        batches = self.batches + 1
        level = _LEVEL / (batches * (batches + 1))
        z = confirmed(before, u, d)
        sums = self.sums + z
        z = torch.maximum(z, sums / math.sqrt(batches))
        certain = self.certain | (torch.erfc(z * math.sqrt(0.5)) <= level / fitted.n)
        return Evidence(certain, sums, batches)


def confirmed(jacobian: SparseJacobian, u: Tensor, d: Tensor) -> Tensor:
    """Return normal numbers [n], which are large where new samples u [K, n], d [K, m] confirm the slopes."""
    u, d = u.double(), d.double()  # without parameter j the sums are small differences
    u, d = u - u.mean(0), d - d.mean(0)
    left, own = d - jacobian.matvec(u).flatten(1), jacobian.squared_lengths.double() * u
    sums = jacobian.rmatvec(left.view(-1, *jacobian.shape)) + own
    length = sums.norm(dim=0)
    r = (u * sums).sum(0) / (u.norm(dim=0) * length).clamp_min(torch.finfo(u.dtype).tiny)
    r = torch.where(length > _ROUNDING * own.norm(dim=0), r, 0.0)
    nu = len(u) - 2.0
    return normal_from_t(r * (nu / (1.0 - r.square()).clamp_min(torch.finfo(u.dtype).eps)).sqrt(), nu)
