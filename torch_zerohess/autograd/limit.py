"""Derivatives of a higher order than the samples serve raise, instead of being zero.

The weights of some families are polynomials in x. Their higher derivatives are zero, which is not an estimate. So
`limited(x, order)` is an identity that counts derivatives. Its derivative adds a zero that depends on x and has
order - 1 derivatives. The derivative of this zero is a zero with one derivative less. The last zero raises.
Derivatives with respect to anything else, such as a vector that multiplies the gradient, pass.

Every `jvp` here applies autograd functions and nothing else. In nested forward mode torch (tried: 2.15) switches the
outer tangents off inside a custom jvp: plain operations lose them without an error, and applied functions do not.
"""

from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.stein import ORDER_ERRORS


def limited(x: Tensor, order: int) -> Tensor:
    """Return x such that derivatives of it of a higher order than `order` (1 or 2) raise ValueError."""
    result: Tensor = Limit.apply(x, order)
    return result


class Limit(torch.autograd.Function):
    """`apply(x, order)`: x, with `order` derivatives."""

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
        return gradient + _Zero.apply(*ctx.saved_tensors, ctx.order - 1, ctx.order), None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:
        result: Tensor = _Sum.apply(tangent, _Zero.apply(*ctx.saved_tensors, ctx.order - 1, ctx.order))
        return result


class _Sum(torch.autograd.Function):
    generate_vmap_rule = True

    @staticmethod
    def forward(a: Tensor, b: Tensor) -> Tensor:
        return a + b

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        pass

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, Tensor]:
        return gradient, gradient

    @staticmethod
    def jvp(ctx: Any, a: Tensor, b: Tensor) -> Tensor:
        result: Tensor = _Sum.apply(a, b)
        return result


class _Zero(torch.autograd.Function):
    """`apply(x, left, order)`: zeros in the shape of x, with `left` derivatives of the `order` there were."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, left: int, order: int) -> Tensor:
        return torch.zeros_like(x)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        x, ctx.left, ctx.order = inputs
        ctx.save_for_backward(x)
        ctx.save_for_forward(x)

    @staticmethod
    def derivative(ctx: Any) -> Tensor:
        if ctx.left == 0:
            raise ValueError(ORDER_ERRORS[ctx.order])
        result: Tensor = _Zero.apply(*ctx.saved_tensors, ctx.left - 1, ctx.order)
        return result

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        return _Zero.derivative(ctx), None, None

    @staticmethod
    def jvp(ctx: Any, *tangents: Any) -> Tensor:
        return _Zero.derivative(ctx)
