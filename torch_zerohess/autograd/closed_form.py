"""The value of a layer in plain eager mode: its gradient in closed form, further derivatives from the general graph.

Plain means: no transform of `torch.func`, no forward mode, no compilation. There a function with `setup_context` costs
more time than a small estimate, and so does the graph of the general formula. Most calls need the gradient alone.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.estimation.expansion import Expansion


class ClosedForm(torch.autograd.Function):
    """`apply(x, expansion, general)`: the base of the expansion around x [B, n], differentiable in x.

    general: the same value as a function of x with a graph, for derivatives of the gradient and for `vmap` over it.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, expansion: Expansion, general: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.save_for_backward(x)
        ctx.expansion, ctx.general = expansion, general
        return expansion.base.to(x.dtype, copy=True)  # the base may share memory with values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        again = torch.is_grad_enabled()
        if again or transforms.watched(gradient) or transforms.forward_mode_active():
            with torch.enable_grad():
                value = ctx.general(x)
            (result,) = torch.autograd.grad(value, x, gradient, create_graph=again)
            return result, None, None
        c = ctx.expansion.coefficients
        a = (c @ gradient.to(c.dtype).reshape(len(c), -1, 1)).mT
        return (ctx.expansion.stein.gradient(a)[:, 0] / ctx.expansion.sigma).to(x.dtype), None, None
