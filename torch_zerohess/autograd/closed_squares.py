"""Squared errors of a Gaussian process as a function of torch, with its first two derivatives in closed form.

In plain eager mode alone: transforms of `torch.func`, forward mode and third derivatives take the general graph.
"""

from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.estimation.control import Prediction
from torch_zerohess.surrogates.squared_distance import SquaredDistance


def losses(predicted: Prediction, z: Tensor) -> Tensor:
    """Return `predicted(z)` for points z [B, Q, n], with derivatives in closed form where they are known."""
    squares = predicted.squared_distance() if z.requires_grad and torch.is_grad_enabled() else None
    if squares is None or _general(z):
        return predicted(z)
    result: Tensor = _Losses.apply(z, squares)
    return result


class _Losses(torch.autograd.Function):
    """`apply(z, squares)`: the losses [B, Q]."""

    @staticmethod
    def forward(ctx: Any, z: Tensor, squares: SquaredDistance) -> Tensor:
        values, gradient, pulled = squares.first(z.double())
        ctx.save_for_backward(z, gradient, pulled)
        ctx.squares = squares
        return values.to(z.dtype)

    @staticmethod
    def backward(ctx: Any, weights: Tensor) -> tuple[Tensor, None]:
        z, gradient, pulled = ctx.saved_tensors
        again = torch.is_grad_enabled()
        if _general(weights):
            with torch.enable_grad():
                value = ctx.squares.general(z)
            return torch.autograd.grad(value, z, weights.to(value), create_graph=again)[0], None
        if again:
            return _Slopes.apply(z, weights, gradient, pulled, ctx.squares), None
        return (weights[..., None] * gradient).to(z.dtype), None


class _Slopes(torch.autograd.Function):
    """`apply(z, weights, gradient, pulled, squares)`: the derivative of the sum of losses with weights."""

    @staticmethod
    def forward(
        ctx: Any,
        z: Tensor,
        weights: Tensor,
        gradient: Tensor,
        pulled: Tensor,
        squares: SquaredDistance,
    ) -> Tensor:
        ctx.save_for_backward(z, weights, gradient, pulled)
        ctx.squares, ctx.hessian = squares, None
        return (weights[..., None] * gradient).to(z.dtype)

    @staticmethod
    def backward(ctx: Any, v: Tensor) -> tuple[Tensor | None, ...]:
        z, weights, gradient, pulled = ctx.saved_tensors
        again = torch.is_grad_enabled()
        if again or _general(v):
            with torch.enable_grad():
                ends = z.view_as(z), weights.view_as(weights)  # weights may depend on z
                value = ctx.squares.general(ends[0])
                (slopes,) = torch.autograd.grad(value, ends[0], ends[1].to(value), create_graph=True)
            wanted = [one for one in ends if one.requires_grad]
            found = iter(torch.autograd.grad(slopes, wanted, v, create_graph=again))
            return *(next(found) if one.requires_grad else None for one in ends), *[None] * 3
        if ctx.hessian is None:  # it serves all products
            ctx.hessian = ctx.squares.hessian(z.double(), pulled)
        product = (ctx.hessian @ v.double()[..., None])[..., 0]
        curved = (weights[..., None] * product).to(z.dtype)
        return curved, (gradient * v).sum(2).to(weights.dtype), *[None] * 3


def _general(tensor: Tensor) -> bool:
    """Whether derivatives are to be taken by transforms, which closed forms do not follow."""
    return transforms.watched(tensor) or transforms.forward_mode_active() or transforms.mapped_in_graph(tensor)
