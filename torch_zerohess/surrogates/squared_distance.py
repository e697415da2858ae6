"""Squared distances of a Gaussian process to given outputs, with two derivatives in closed form.

For chosen points p_m in units of the lengths, covariances k(d) at distances d_m = |z - p_m|, slopes s = k'(d) / d,
bends t = s'(d) / d and errors e = W^T k + c - y:

    l(z)     = |e|^2 + b
    gradient = 2 sum_m q_m s_m (z - p_m),                                      q = W e
    Hessian  = 2 J J^T + 2 sum_m q_m (s_m I + t_m (z - p_m)(z - p_m)^T),       J = sum_m s_m (z - p_m) W_m^T

Autograd takes twice as long for the gradient, and as long as all this again for each column of the Hessian.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from torch_zerohess.surrogates.gaussian_process import CONSTANT
from torch_zerohess.surrogates.inducing import InducedProcess
from torch_zerohess.surrogates.kernels import ZERO, bends, with_slopes

_ROWS = 256
"""Points whose covariances are held at once: they fit into the cache of a processor."""


class First(NamedTuple):
    """What one pass gives."""

    values: Tensor
    """[B, Q]"""
    gradient: Tensor
    """[B, Q, n]"""
    pulled: Tensor
    """q [B, Q, M], for the Hessian."""


class _Around(NamedTuple):
    """Some points and the chosen ones in units of the lengths, around the middle of the chosen ones."""

    z: Tensor
    """[K, n]"""
    p: Tensor
    """[M, n]"""
    distances: Tensor
    """[K, M]"""
    covariances: Tensor
    slopes: Tensor


@dataclass(frozen=True)
class SquaredDistance:
    """|g(z) - y|^2 + b at points z [B, Q, n], for a process g over z / lengths; all tensors are float64."""

    process: InducedProcess
    lengths: Tensor
    """[n]"""
    y: Tensor
    """[B, m]"""
    b: Tensor
    """[B]"""

    def general(self, z: Tensor) -> Tensor:
        """Return l [B, Q] in the type of z, with a graph of every order: a later fit does not change it."""
        e = self.process((z.double() / self.lengths).flatten(0, 1)).unflatten(0, z.shape[:2]) - self.y[:, None]
        return (e.square().sum(2) + self.b[:, None]).to(z.dtype)

    def first(self, z: Tensor) -> First:
        """Return l, its gradient and what `hessian` needs."""
        squares, *others = self._in_parts(self._first, z, self._targets(z))
        return First(squares + self.b[:, None], *others)

    def hessian(self, z: Tensor, pulled: Tensor) -> Tensor:
        """Return the Hessians [B, Q, n, n]; `pulled` is of `first`."""
        return self._in_parts(self._hessian, z, pulled)[0]

    def _targets(self, z: Tensor) -> Tensor:
        return self.y[:, None].expand(-1, z.shape[1], -1)

    def _in_parts(self, function: Callable[..., tuple[Tensor, ...]], *tensors: Tensor) -> list[Tensor]:
        """Call a function of tensors [K, ...] with a few rows of [B, Q, ...] at a time, and join the results."""
        parts = [function(*one) for one in zip(*(one.flatten(0, 1).split(_ROWS) for one in tensors), strict=True)]
        return [torch.cat(one).unflatten(0, tensors[0].shape[:2]) for one in zip(*parts, strict=True)]

    def _around(self, z: Tensor) -> _Around:
        chosen = self.process.points
        middle = chosen.sum(0) / max(len(chosen), 1)
        z, p = z / self.lengths - middle, chosen - middle
        squares = torch.addmm(p.square().sum(1), z, p.mT, alpha=-2.0).add_(z.square().sum(1, keepdim=True))
        distances = squares.clamp_(min=ZERO).sqrt_()
        return _Around(z, p, distances, *with_slopes(self.process.kernel, distances))

    def _errors(self, at: _Around, y: Tensor) -> Tensor:
        weights = self.process.weights
        return torch.addmm(self.process.mean + CONSTANT * weights.sum(0) - y, at.covariances, weights)

    def _first(self, z: Tensor, y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        at = self._around(z)
        e = self._errors(at, y)
        q = e @ self.process.weights.mT
        gradient = _weighted_sum(q * at.slopes, at)
        return e.square().sum(1), 2.0 * gradient / self.lengths, q

    def _hessian(self, z: Tensor, q: Tensor) -> tuple[Tensor]:
        at = self._around(z)
        bent = bends(self.process.kernel, at.distances, at.slopes).mul_(q)
        J, rows = [], []
        for i in range(z.shape[1]):
            apart = at.z[:, i, None] - at.p[:, i]
            J.append((at.slopes * apart) @ self.process.weights)
            rows.append(_weighted_sum(apart.mul_(bent), at))
        jacobian = torch.stack(J, 1)
        half = torch.baddbmm(torch.stack(rows, 1), jacobian, jacobian.mT)
        half.diagonal(dim1=1, dim2=2).add_((q * at.slopes).sum(1, keepdim=True))
        return (2.0 * half / (self.lengths[:, None] * self.lengths),)


def _weighted_sum(weights: Tensor, at: _Around) -> Tensor:
    """Return the sums [K, n] of z - p_m with weights [K, M]."""
    return weights.sum(1, keepdim=True) * at.z - weights @ at.p
