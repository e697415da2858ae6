"""Variance of Stein sums from the spread of their independent draws."""

import torch
from torch import Tensor

from torch_zerohess.estimation.stein import Elementwise, LikelihoodRatio, SignedLobes, Stein
from torch_zerohess.sampling.proposals import NORMAL

_CHUNK = 1 << 22  # numbers held at a time


def variance(stein: Stein, quantity: str, a: Tensor, share: Tensor, draws: list[Tensor], v: Tensor | None) -> Tensor:
    """Return the variance of value [B, P], gradient, hessian_diagonal or hvp [B, P, n], in units of sigma.

    a: coefficients [B, P, K]; share: of each row in a mean [B, K], zero where it was dropped; draws: rows [D, r] of the
    independent draws, by size; v: [B, P, n] for the hvp. With D draws y_d of share s_d of the sum Y, the variance is
    D/(D-1) sum_d (y_d - s_d Y)^2.
    """
    if isinstance(stein, Elementwise):
        return _elementwise(stein, quantity, a, draws, v)
    draws = [one.to(a.device) for one in draws]
    shares = [share[:, one].sum(2) for one in draws]  # [B, D] each
    D = torch.stack([(one > 0).sum(1) for one in shares]).sum(0).double()
    if bool((D < 2).any()):
        raise ValueError(
            "a standard error needs at least two independent draws: use more samples (an even number for 'sobol')"
        )
    whole = _apply(stein, quantity, a, v)
    tail = (1,) * (whole.dim() - 1)
    result = torch.zeros_like(whole)
    for same, their_share in zip(draws, shares, strict=True):
        size = same.shape[1]
        step = max(1, _CHUNK // (size * max(1, whole.numel())))
        for part, s_d in zip(same.split(step), their_share.split(step, 1), strict=True):
            B, P, count = a.shape[0], a.shape[1], len(part)
            coefficients = a[:, :, part].movedim(2, 1).reshape(B * count, P, size)
            vectors = None if v is None else v.repeat_interleave(count, 0)
            y = _apply(stein.subset(part), quantity, coefficients, vectors).unflatten(0, (B, count))
            result += ((y - s_d.reshape(B, count, *tail) * whole[:, None]) ** 2).sum(1)
    return result * (D / (D - 1)).reshape(-1, *tail)


def _apply(stein: LikelihoodRatio | SignedLobes, quantity: str, a: Tensor, v: Tensor | None) -> Tensor:
    if quantity == "hvp" and v is not None:
        return stein.hvp(a, v)
    sums = {"value": stein.value, "gradient": stein.gradient, "hessian_diagonal": stein.hessian_diagonal}
    return sums[quantity](a)


def _elementwise(stein: Elementwise, quantity: str, a: Tensor, draws: list[Tensor], v: Tensor | None) -> Tensor:
    """Every draw has one element: its number is squared where the sums have it as it is, element by element."""
    index = draws[0].to(a.device)
    S = int((stein.rows[index[:, 0], 2] == NORMAL).sum())
    if S < 2:
        raise ValueError("a standard error of proposal 'optimal' needs at least 2 samples per element, got 1")
    y = (a * stein.weight[:, None])[:, :, index].sum(3)
    rows = stein.rows[index[:, 0]]
    squares = Elementwise(torch.ones_like(y[:, 0]), rows, stein.n, stein.order)

    def spread(total: Tensor, sums: Tensor) -> Tensor:
        return (sums - total**2 / S) * (S / (S - 1))

    if quantity == "value":
        return spread(squares.value(y), squares.value(y * y))
    if quantity == "gradient":
        return spread(squares.gradient(y), squares.gradient(y * y))
    elements = spread(squares.hessian(y), squares.hessian(y * y))
    if quantity == "hvp" and v is not None:
        return (elements @ (v * v)[..., None])[..., 0]
    return elements.diagonal(dim1=2, dim2=3)
