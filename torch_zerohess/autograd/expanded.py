"""An expansion as a function of x that torch differentiates."""

import functools

import torch
from torch import Tensor

from torch_zerohess.autograd.limit import limited
from torch_zerohess.autograd.linear_map import product, project
from torch_zerohess.estimation.expansion import Expansion


def general(expansion: Expansion, x: Tensor, *, center: Tensor, zero: bool) -> Tensor:
    """Return the expansion around `center` at x [B, n], with a graph; zero: says that x equals `center` in value."""
    stein, c = expansion.stein, expansion.coefficients

    def ratios(d: Tensor, zero: bool) -> Tensor:
        d = d if stein.highest is None else limited(d, stein.highest)
        return product(stein.ratio(d, functools.partial(project, zero=zero))[:, None], c.mT)[:, 0]

    d = (x.double() - center.double()) / expansion.sigma
    total = ratios(d, zero)
    change = total - (total if zero else ratios(torch.zeros_like(d), True)).detach()
    return (expansion.base + change.reshape(expansion.base.shape)).to(x.dtype)


def tangent(expansion: Expansion, x: Tensor, center: Tensor) -> Tensor:
    """Return the expansion around `center` at x [B, n], to first order."""
    slope = expansion.stein.scaled_gradient(expansion.coefficients.mT.contiguous(), expansion.sigma)
    change = (slope @ (x.double() - center.double())[..., None])[..., 0]
    return (expansion.base + change.reshape(expansion.base.shape)).to(x.dtype)
