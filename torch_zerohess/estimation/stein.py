"""Stein's identities as sums over samples, one class per family of weights.

Every estimate is a weighted sum of black-box values f_k with a kernel in the dimensionless perturbation u_k:

| | likelihood ratio | element-wise (optimal) | signed lobes (FR22) |
|---|---|---|---|
| value | w_k | 1 on the rows of the value | 1 |
| gradient_i | w_k u_i | sign(u_i) sqrt(2/pi) on the rows of i | sign(u_i) sqrt(2/pi) |
| Hessian_ij | w_k (u_i u_j - delta_ij) | constant times sign on the rows of ij | none |

`ratio(d)` is the generating function of all three: its value at d = (x - x_0)/sigma = 0 is the kernel of the value, its
first and second derivative those of gradient and Hessian. For likelihood ratios it is N(z; x) / p(z) itself,
w exp(u.d - d.d/2), so that derivatives of every order are the estimators of theirs.

Shapes: B batch, K samples, M vectors, n parameters; a [B, M, K] are the coefficients, values over K. All float64 and in
units of sigma: the caller divides by sigma.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.autograd.linear_map import FIRST_ORDER_ERROR, Samples, first_order_only, project
from torch_zerohess.sampling import kernels
from torch_zerohess.sampling.kernels import Redrawn
from torch_zerohess.sampling.proposals import DIAGONAL_LOBE, GRADIENT_LOBE, NORMAL, OFF_DIAGONAL_LOBE

_BLOCK = 4096


@dataclass(frozen=True)
class LikelihoodRatio:
    """Samples of a density p with weights N/p, which serve every order at once."""

    u: Samples
    """[B, K, n], or the recipe to draw it again."""
    weight: Tensor
    """N(u) / p(u), [B, K]."""

    def value(self, a: Tensor) -> Tensor:
        return total((a * self.weight[:, None]).mT)[:, 0]

    def gradient(self, a: Tensor) -> Tensor:
        return kernels.accumulate(self.u, a * self.weight[:, None])

    def hvp(self, a: Tensor, v: Tensor) -> Tensor:
        a = a * self.weight[:, None]
        return kernels.accumulate(self.u, a * kernels.project(self.u, v)) - total(a.mT).mT * v

    def hessian_diagonal(self, a: Tensor) -> Tensor:
        a = a * self.weight[:, None]
        return kernels.accumulate_squares(self.u, a) - total(a.mT).mT

    def hessian(self, a: Tensor) -> Tensor:
        a = a * self.weight[:, None]
        result = kernels.hessian(self.u, a)
        result.diagonal(dim1=2, dim2=3).sub_(total(a.mT).mT)
        return result

    def ratio(self, d: Tensor, *, zero: bool = False) -> Tensor:
        """Return w exp(u.d - d.d/2), [B, K], differentiable in d [B, n]; `zero` says that d is zero in value."""
        exponent = project(self.u, d[:, None], zero=zero)[:, 0] - 0.5 * (d * d).sum(1, keepdim=True)
        return self.weight * exponent.exp()

    def subset(self, index: Tensor) -> "LikelihoodRatio":
        """Return the draws index [D, r], r rows each, as a batch of B * D estimates."""
        if isinstance(self.u, Redrawn):
            S = len(self.u.rows) // len(self.u.x)
            first = index[:, 0]  # the rows of a drawn pair are s and s + S
            rows = self.u.rows.view(-1, S, 5)[:, first].reshape(-1, 5)
            u = self.u._replace(rows=rows, x=self.u.x.repeat_interleave(len(index), 0))
            return LikelihoodRatio(u, self.weight[:, index].flatten(0, 1))
        return LikelihoodRatio(self.u[:, index].flatten(0, 1), self.weight[:, index].flatten(0, 1))


@dataclass(frozen=True)
class Elementwise:
    """One sample set for the value, for every gradient element and for every Hessian element, with constant weights."""

    weight: Tensor
    """Signed constant weight of each row for its own element, [B, K], the K over the set's own size included."""
    rows: Tensor
    """int64 [K, 5]; columns 2 to 4 are the kind of element and its dimensions i <= j."""
    n: int
    order: int

    def value(self, a: Tensor) -> Tensor:
        return (a * self.weight[:, None])[..., self.rows[:, 2] == NORMAL].sum(2)

    def gradient(self, a: Tensor) -> Tensor:
        chosen = self.rows[:, 2] == GRADIENT_LOBE
        result = a.new_zeros(*a.shape[:2], self.n)
        return result.index_add_(2, self.rows[chosen, 3], (a * self.weight[:, None])[..., chosen])

    def hvp(self, a: Tensor, v: Tensor) -> Tensor:
        return (self.hessian(a) @ v[..., None])[..., 0]

    def hessian_diagonal(self, a: Tensor) -> Tensor:
        return self.hessian(a).diagonal(dim1=2, dim2=3)

    def hessian(self, a: Tensor) -> Tensor:
        if self.order == 1:
            raise ValueError(FIRST_ORDER_ERROR)
        chosen = (self.rows[:, 2] == DIAGONAL_LOBE) | (self.rows[:, 2] == OFF_DIAGONAL_LOBE)
        i, j = self.rows[chosen, 3], self.rows[chosen, 4]
        upper = a.new_zeros(*a.shape[:2], self.n * self.n)
        upper = upper.index_add_(2, i * self.n + j, (a * self.weight[:, None])[..., chosen])
        upper = upper.unflatten(2, (self.n, self.n))
        return upper + upper.triu(1).mT

    def ratio(self, d: Tensor, *, zero: bool = False) -> Tensor:
        """Return the quadratic in d [B, n] whose derivatives are the kernels, [B, K]."""
        if self.order == 1:
            d = first_order_only(d)
        kind, i, j = self.rows[:, 2], self.rows[:, 3], self.rows[:, 4]
        d_i, d_j = (d.gather(1, index.expand(len(d), -1)) for index in (i, j))  # its backward has a vmap rule
        hessian = torch.where(kind == DIAGONAL_LOBE, 0.5, 1.0) * d_i * d_j
        factor = torch.where(kind == NORMAL, 1.0, torch.where(kind == GRADIENT_LOBE, d_i, hessian))
        return self.weight * factor


@dataclass(frozen=True)
class SignedLobes:
    """FR22: all dimensions at once from the signed gradient lobe. First order only, biased for n > 1.

    It smooths the other dimensions with the gradient's lobe instead of the Gaussian (Fischer and Ritschel 2023).
    """

    u: Tensor
    """sign(u) sqrt(2/pi), [B, K, n]."""

    def value(self, a: Tensor) -> Tensor:
        return a.sum(2)

    def gradient(self, a: Tensor) -> Tensor:
        return kernels.accumulate(self.u, a)

    def hvp(self, a: Tensor, v: Tensor) -> Tensor:
        raise ValueError(FIRST_ORDER_ERROR)

    def hessian_diagonal(self, a: Tensor) -> Tensor:
        raise ValueError(FIRST_ORDER_ERROR)

    def hessian(self, a: Tensor) -> Tensor:
        raise ValueError(FIRST_ORDER_ERROR)

    def ratio(self, d: Tensor, *, zero: bool = False) -> Tensor:
        """Return 1 + k.d, [B, K], differentiable once in d [B, n]."""
        return 1.0 + project(self.u, first_order_only(d)[:, None], zero=zero)[:, 0]

    def subset(self, index: Tensor) -> "SignedLobes":
        """Return the draws index [D, r], r rows each, as a batch of B * D estimates."""
        return SignedLobes(self.u[:, index].flatten(0, 1))


def total(a: Tensor) -> Tensor:
    """Sum [B, K, P] over K to [B, 1, P] block by block: the order of one long sum follows the number of threads."""
    whole = a.shape[1] // _BLOCK * _BLOCK
    blocks = a[:, :whole].unflatten(1, (-1, _BLOCK)).sum(2).sum(1, keepdim=True)
    return blocks + a[:, whole:].sum(1, keepdim=True)


Stein = LikelihoodRatio | Elementwise | SignedLobes
