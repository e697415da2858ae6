"""Slopes on a known support, their standard errors, and which of them are significant.

With A [K, s] of the columns of u on the support of a row, P the diagonal matrix of K ridge^2, and what the fit leaves
e = d - A J, the slopes are J = M (A^T d + P J') with M = (A^T A + P)^-1. The variance of e_k usually depends on u_k: it
grows with |u_k| if the black box is curved. So the variances of the slopes are

    sum_k (M a_k)^2 e_k^2 / (1 - h_k)^2 ,     h_k = a_k^T M a_k + the leverage of the constant,

in which e_k / (1 - h_k) is what the fit without sample k leaves of it (HC3: MacKinnon and White 1985). The error of the
prior is added: (M P (J - J'))^2, and the diagonal of s^2 M P M, where s^2 is the mean of e^2.

CPU tensors go to the C++ extension if it was built. What follows is the literal reference of `csrc/sparse.h`.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

from torch_zerohess.sampling import extension
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_Case = tuple[Tensor, Tensor, Tensor, Tensor, SparseJacobian]
"""Directions u [K, n], changes d [K, m], parameters [m, keep], which of them are used, and the previous slopes."""
_BLOCK = 1 << 22
"""Elements of A held at a time."""


@dataclass(frozen=True)
class _Rows:
    """The regressions of some rows."""

    which: slice
    live: Tensor
    """Which entries are used [b, s]."""
    A: Tensor
    """[b, s, K], transposed; 0 where an entry is not used."""
    old: Tensor
    """The previous slopes of these entries [b, s]."""
    target: Tensor
    """Changes that the previous slopes do not predict [b, K]."""
    gram: Tensor
    """A^T A [b, s, s]."""
    weight: Tensor
    """Prior of a ridge of 1 [b, s]."""

    def prior(self, ridges: tuple[float, float]) -> Tensor:
        """Return the diagonal of P [b, s], for the squares of the ridges of old and of new entries."""
        return (
            torch.where(self.old != 0, self.weight.new_tensor(ridges[0]), self.weight.new_tensor(ridges[1]))
            * self.weight
        )

    def factor(self, prior: Tensor) -> Tensor:
        """Return the Cholesky factor of A^T A + P [b, s, s]."""
        return torch.linalg.cholesky(self.gram + torch.diag_embed(prior))


def _regressions(u: Tensor, d: Tensor, index: Tensor, used: Tensor, previous: SparseJacobian) -> Iterator[_Rows]:
    """Yield the regressions of all rows, some at a time."""
    K, m, rows = len(u), len(index), u.mT.contiguous()
    # Systems are small if the used entries come first, and few are used.
    in_use = used.any(0).nonzero()
    width = int(in_use[-1]) + 1 if len(in_use) else 1
    size = max(1, _BLOCK // (K * width))
    for first in range(0, m, size):
        some = slice(first, first + size)
        own, live = index[some, :width], used[some, :width]
        same = (own[:, :, None] == previous.index[some][:, None]) & (previous.values[some] != 0)[:, None]
        old = (same * previous.values[some][:, None]).sum(2) * live
        A = rows[own] * live[:, :, None]
        target = d[:, some].mT - (A * old[:, :, None]).sum(1)
        yield _Rows(some, live, A, old, target, A @ A.mT, K * _scale(u, own))


def slopes_by_ridges(
    u: Tensor,
    d: Tensor,
    index: Tensor,
    used: Tensor,
    previous: SparseJacobian,
    choices: Sequence[tuple[float, float]],
) -> list[Tensor]:
    """Return the slopes [m, keep] of `slopes` for each of several ridges."""
    if extension.available and u.is_cpu:
        return list(_compiled((u, d, index, used, previous), choices)[0])
    values = [torch.zeros_like(index, dtype=u.dtype) for _ in choices]
    for rows in _regressions(u, d, index, used, previous):
        change = rows.A @ rows.target[:, :, None]
        for one, ridges in zip(values, choices, strict=True):
            solved = torch.cholesky_solve(change, rows.factor(rows.prior(ridges)))[..., 0]
            one[rows.which, : rows.live.shape[1]] = (rows.old + solved) * rows.live
    return values


def slopes(
    u: Tensor,
    d: Tensor,
    index: Tensor,
    used: Tensor,
    previous: SparseJacobian,
    ridges: tuple[float, float],
    constant: Tensor | None = None,
    *,
    shortened: bool = True,
) -> tuple[Tensor, Tensor]:
    """Return slopes [m, keep] on a support and their standard errors, with the previous slopes as the prior.

    constant: leverage of the constant on each sample [K]. If it is None, all samples have the same variance.
    shortened: whether errors include that the ridge shortens new slopes; it shortens none that is 0.
    """
    if extension.available and u.is_cpu:
        case = u, d, index, used, previous
        found, deviations = _compiled(case, [ridges], constant, errors=True, shortened=shortened)
        return found[0], deviations
    K, values = len(u), torch.zeros_like(index, dtype=u.dtype)
    errors = torch.zeros_like(values)
    for rows in _regressions(u, d, index, used, previous):
        A, old, live, prior = rows.A, rows.old, rows.live, rows.prior(ridges)
        inverse = torch.cholesky_inverse(rows.factor(prior))
        change = (inverse @ (A @ rows.target[:, :, None]))[..., 0]
        left = rows.target - (A * change[:, :, None]).sum(1)
        own_part = inverse.diagonal(dim1=1, dim2=2)
        spent = ((1.0 - own_part * prior) * live).sum(1).clamp_min(0.0)
        variance = left.square().sum(1) / (K - 1 - spent).clamp_min(1.0)
        by_ridge = prior * change * (1.0 if shortened else old != 0)
        bias = (inverse @ by_ridge[:, :, None])[..., 0]
        if constant is None:
            square = variance[:, None] * own_part.clamp_min(0.0)
        else:
            square = _of_samples(A, inverse, left, constant)
            square += variance[:, None] * (inverse.square() * prior[:, None]).sum(2)  # of the prior
        values[rows.which, : live.shape[1]] = (old + change) * live
        errors[rows.which, : live.shape[1]] = (square + bias.square()).sqrt() * live
    return values, errors


def _compiled(
    case: _Case,
    choices: Sequence[tuple[float, float]],
    constant: Tensor | None = None,
    *,
    errors: bool = False,
    shortened: bool = True,
) -> tuple[Tensor, Tensor]:
    """Return slopes [choices, m, keep] and errors of the first of them [m, keep], by the C++ extension."""
    u, d, index, used, previous = case
    scale = len(u) * u.square().mean(0).clamp_min(torch.finfo(u.dtype).tiny)
    values, deviations, failed = torch.ops.torch_zerohess.regress(
        *(one.contiguous() for one in (u.mT, scale, d.mT, index, used, previous.index, previous.values.to(u))),
        u.new_tensor(choices),
        constant,
        errors,
        shortened,
    )
    if failed:
        message = f"the normal equations of {int(failed)} outputs are not positive definite"
        raise torch.linalg.LinAlgError(message)  # type: ignore[attr-defined]
    return values, deviations


def _of_samples(A: Tensor, inverse: Tensor, left: Tensor, constant: Tensor) -> Tensor:
    """Return the variances [b, width] of slopes by HC3, for what the fit leaves of the samples [b, K]."""
    influence = inverse @ A
    rest = 1.0 - constant - (A * influence).sum(1)
    left_out = left / rest.clamp_min(torch.finfo(left.dtype).eps ** 0.5)
    return influence.mul_(left_out[:, None]).square_().sum(2)


def _scale(u: Tensor, own: Tensor) -> Tensor:
    """Mean squares of the directions along parameters."""
    return u.square().mean(0).clamp_min(torch.finfo(u.dtype).tiny)[own]


def predicted(index: Tensor, values: Tensor, u: Tensor) -> Tensor:
    """Return the changes [K, m] along u [K, n] that slopes predict."""
    live = (values != 0).any(0).nonzero()
    if not len(live):
        return u.new_zeros(len(u), len(index))
    width = int(live[-1]) + 1
    sums = embedding_bag(index[:, :width], u.mT.contiguous(), mode="sum", per_sample_weights=values[:, :width])
    return sums.mT.contiguous()


def significant(values: Tensor, errors: Tensor, used: Tensor, K: float, rate: float) -> Tensor:
    """Return the slopes [m, keep] that errors alone do not explain, at a rate of false discoveries."""
    chance = chances(values, errors, used, K)
    return chance <= threshold(chance[used], rate)


def threshold(chance: Tensor, rate: float) -> Tensor | float:
    """Return the chance up to which tests are discoveries, by Benjamini and Hochberg (1995).

    chance: probabilities [N] of tests in which there is nothing to discover.
    rate: expected share of false discoveries, at most.
    """
    ordered = chance.sort().values
    fine = (ordered <= rate * torch.arange(1, len(ordered) + 1, device=chance.device) / max(len(ordered), 1)).nonzero()
    return ordered[fine[-1, 0]] if len(fine) else -1.0


def chances(values: Tensor, errors: Tensor, used: Tensor, K: float) -> Tensor:
    """Return the probabilities [m, keep] of slopes as large, in K samples, where an output does not depend on them.

    They are from Student's t with K - 1 - s degrees of freedom, s entries of the row.
    """
    nu = (K - 1 - used.sum(1, keepdim=True)).clamp_min(1).double()
    t = values.double() / errors.double().clamp_min(torch.finfo(torch.float64).tiny)
    return torch.erfc(normal_from_t(t, nu).abs() * math.sqrt(0.5))


def normal_from_t(t: Tensor, nu: Tensor | float) -> Tensor:
    """Return normal numbers with the probabilities of Student's t with nu degrees of freedom (Wallace 1959)."""
    return t.sign() * (8 * nu + 1) / (8 * nu + 3) * (nu * torch.log1p(t.square() / nu)).sqrt()
