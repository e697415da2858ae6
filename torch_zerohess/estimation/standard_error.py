"""Variance of Stein sums from the spread of their independent draws."""

from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from torch_zerohess.estimation.stein import Quantity, Stein

_CHUNK = 1 << 22  # numbers held at a time


class Divisible(Protocol):
    """A family whose rows can be split into draws, each of which estimates everything."""

    def sums(self, quantity: Quantity, a: Tensor, v: Tensor | None) -> Tensor:
        """See `Stein.sums`."""

    def subset(self, index: Tensor) -> Stein:
        """Return the draws index [D, r], of r rows each, as a batch of B * D estimates."""


def variance_of_draws(
    stein: Divisible, quantity: Quantity, a: Tensor, share: Tensor, draws: Sequence[Tensor], v: Tensor | None
) -> Tensor:
    """Return the variance of value [B, P], gradient, hessian_diagonal or hvp [B, P, n], in units of sigma.

    With D draws y_d, each of share s_d of the sum Y, the variance is D/(D-1) sum_d (y_d - s_d Y)^2.

    Args:
        stein: the family.
        quantity: which sum.
        a: coefficients [B, P, K].
        share: weight of each row in a mean [B, K], zero where the row was dropped.
        draws: rows of the independent draws, int64 [D, r], draws of the same size together.
        v: vector of the hvp, [B, P, n].

    Raises:
        ValueError: fewer than two independent draws are left.
    """
    draws = [one.to(a.device) for one in draws]
    shares = [share[:, one].sum(2) for one in draws]  # [B, D] each
    D = torch.stack([(one > 0).sum(1) for one in shares]).sum(0).double()
    if bool((D < 2).any()):
        raise ValueError(
            "a standard error needs at least two independent draws: use more samples (an even number for 'sobol')"
        )
    whole = stein.sums(quantity, a, v)
    tail = (1,) * (whole.dim() - 1)
    result = torch.zeros_like(whole)
    for same, their_share in zip(draws, shares, strict=True):
        size = same.shape[1]
        step = max(1, _CHUNK // (size * max(1, whole.numel())))
        for part, s_d in zip(same.split(step), their_share.split(step, 1), strict=True):
            B, P, count = a.shape[0], a.shape[1], len(part)
            coefficients = a[:, :, part].movedim(2, 1).reshape(B * count, P, size)
            vectors = None if v is None else v.repeat_interleave(count, 0)
            y = stein.subset(part).sums(quantity, coefficients, vectors).unflatten(0, (B, count))
            result += ((y - s_d.reshape(B, count, *tail) * whole[:, None]) ** 2).sum(1)
    return result * (D / (D - 1)).reshape(-1, *tail)
