"""Variance of Stein sums from the spread of their independent draws."""

import torch
from torch import Tensor

from torch_zerohess.proposals import NORMAL
from torch_zerohess.stein import Elementwise, LikelihoodRatio, SignedLobes, Stein

_CHUNK = 1 << 22  # numbers held at a time


def variance(stein: Stein, quantity: str, a: Tensor, draws: list[Tensor], v: Tensor | None) -> Tensor:
    """Return the variance of value [B, P], gradient, hessian_diagonal or hvp [B, P, n], in units of sigma.

    a: coefficients [B, P, K]; draws: rows [D, r] of the independent draws, by size; v: [B, P, n] for the hvp.
    With D draws y_d of expected share s_d of the sum Y, the variance is D/(D-1) sum_d (y_d - s_d Y)^2.
    """
    if isinstance(stein, Elementwise):
        return _elementwise(stein, quantity, a, draws, v)
    D = sum(len(part) for part in draws)
    if D < 2:
        raise ValueError(
            "a standard error needs at least two independent draws: use more samples (an even number for 'sobol')"
        )
    total = _apply(stein, quantity, a, v)
    result = torch.zeros_like(total)
    for same in draws:
        size = same.shape[1]
        for part in same.to(a.device).split(max(1, _CHUNK // (size * max(1, total.numel())))):
            B, P, count = a.shape[0], a.shape[1], len(part)
            coefficients = a[:, :, part].movedim(2, 1).reshape(B * count, P, size)
            vectors = None if v is None else v.repeat_interleave(count, 0)
            y = _apply(stein.subset(part), quantity, coefficients, vectors).unflatten(0, (B, count))
            result += ((y - (size / a.shape[2]) * total[:, None]) ** 2).sum(1)
    return result * (D / (D - 1))


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
