"""The parameters that some output was found to depend on, by sparse Jacobians that are fitted one after the other.

A selection at a rate of false discoveries among pairs has false entries, and they hit many parameters. So each
parameter is tested by itself, and those that are found are chosen at a rate of false discoveries among parameters
(Benjamini and Hochberg 1995).

The first batch tests a parameter by its most significant entry, times the number of outputs (Bonferroni). Every later
batch tests parameter j by new samples, with the slopes J of the fit before. The Jacobian without parameter j leaves e
of the changes, [K, m]. If no output depends on j, the sums c = sum_i J_ij e_i are independent of the directions u_j,
[K]. So their correlation has a known distribution, whatever J is, and z is the normal number of its probability. The
sum of z over b batches grows where the slopes are true. Both z and sum / sqrt(b) are tested on one side, and the larger
one of them has at most the probability erfc(z / sqrt 2).
"""

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.sparse_regression import chances, normal_from_t, threshold
from torch_zerohess.surrogates.sparse_selection import lengths

_RATE = 5e-3
"""Expected share of parameters that no output depends on, among those that are found in a batch, at most."""

_ROUNDING = 1e-6
"""Sums below this share of what parameter j adds to them are rounding."""


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the batches so far show about every parameter."""

    found: Tensor
    """Whether some output was found to depend on it, bools [n]."""
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
            least = torch.ones(fitted.n, dtype=torch.float64, device=u.device)
            least.scatter_reduce_(0, fitted.index[used], chance[used], "amin")
            return replace(self, found=self.found | _found(least * len(used)))
        batches = self.batches + 1
        z = confirmed(before, u, d)
        sums = self.sums + z
        z = torch.maximum(z, sums / math.sqrt(batches))
        found = self.found | _found(torch.erfc(z * math.sqrt(0.5)))
        return Evidence(found, sums, batches)

    def of_all(self) -> "Evidence":
        """Return evidence by which every parameter is found."""
        return replace(self, found=torch.ones_like(self.found))


def _found(chance: Tensor) -> Tensor:
    """Return which parameters are found, by the probabilities [n] of their tests if no output depends on them."""
    return chance <= threshold(chance, _RATE)


def confirmed(jacobian: SparseJacobian, u: Tensor, d: Tensor) -> Tensor:
    """Return normal numbers [n], which are large where new samples u [K, n], d [K, m] confirm the slopes."""
    u, d = u.double(), d.double()  # without parameter j the sums are small differences
    u, d = u - u.mean(0), d - d.mean(0)
    left, own = d - jacobian.matvec(u).flatten(1), jacobian.squared_lengths.double() * u
    sums = jacobian.rmatvec(left.view(-1, *jacobian.shape)) + own
    length = lengths(sums)
    r = (u * sums).sum(0) / (lengths(u) * length).clamp_min(torch.finfo(u.dtype).tiny)
    r = torch.where(length > _ROUNDING * lengths(own), r, 0.0)
    nu = len(u) - 2.0
    return normal_from_t(r * (nu / (1.0 - r.square()).clamp_min(torch.finfo(u.dtype).eps)).sqrt(), nu)
