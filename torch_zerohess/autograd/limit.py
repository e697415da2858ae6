"""Derivatives of a higher order than the samples serve raise, instead of being zero.

The weights of some families are polynomials in x. Their higher derivatives are zero, and that is not an estimate. The
identity `limited(x, order)` counts how often it was differentiated: its derivative is another identity that remembers
x and the order that is left, and with none left that identity has no derivative.
"""

from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.stein import ORDER_ERRORS


def limited(x: Tensor, order: int) -> Tensor:
    """Return x such that derivatives of it of a higher order than `order` (1 or 2) raise ValueError."""
    if torch.compiler.is_compiling():
        from torch_zerohess.autograd import in_graph  # loaded late: it loads the compiler

        compiled: Tensor = in_graph.limited(x, order)
        return compiled
    result: Tensor = Limit.apply(x, order)
    return result


class Limit(torch.autograd.Function):
    """The identity, with `order` derivatives."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, order: int) -> Tensor:
        return x.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        x, ctx.order = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        return _Derivative.apply(gradient, *ctx.saved_tensors, ctx.order - 1, ctx.order), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        result: Tensor = _Derivative.apply(tangent, *ctx.saved_tensors, ctx.order - 1, ctx.order)
        return result


class _Derivative(torch.autograd.Function):
    """`apply(gradient, x, left, order)`: the gradient, as something that depends on x and has `left` derivatives."""

    generate_vmap_rule = True

    @staticmethod
    def forward(gradient: Tensor, x: Tensor, left: int, order: int) -> Tensor:
        return gradient.clone()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        _, x, ctx.left, ctx.order = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def next(ctx: Any, vector: Tensor | None) -> Tensor:
        if ctx.left == 0:
            raise ValueError(ORDER_ERRORS[ctx.order])
        (x,) = ctx.saved_tensors
        result: Tensor = _Derivative.apply(torch.zeros_like(x) if vector is None else vector, x, ctx.left - 1, ctx.order)
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None, None]:
        return _Derivative.next(ctx, gradient), None, None, None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor | None, *_: Any) -> Tensor:
        return _Derivative.next(ctx, tangent)
