"""The value of a layer in plain eager mode: its gradient in closed form, further derivatives from the general graph.

Plain means: no transform of `torch.func`, no forward mode, no compilation. In plain mode a function with
`setup_context` takes more time than a small estimate, and so does the graph of the general formula. Most calls need
the gradient alone.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.autograd.marker import Input
from torch_zerohess.estimation.expansion import Expansion


class ClosedForm(torch.autograd.Function):
    """`apply(x, expansion, general)`: the base of the expansion around x, [*batch, *out] for x [*batch, n].

    general: the same value as a function of x [B, n] with a graph, for derivatives of the gradient and for `vmap` over
    it. Like `Input`, it saves the input of the black box.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor, expansion: Expansion, general: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.save_for_backward(x)
        ctx.expansion, ctx.general = expansion, general
        base = expansion.base.reshape((*x.shape[:-1], *expansion.base.shape[1:]))
        return base.to(x.dtype, copy=True)  # the base may share memory with values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None, None]:
        (x,) = ctx.saved_tensors
        again = torch.is_grad_enabled()
        if again or transforms.watched(gradient) or transforms.forward_mode_active():
            with torch.enable_grad():
                with transforms.outside():
                    marked = Input.apply(x)
                value = ctx.general(marked.reshape(-1, x.shape[-1]))
            (result,) = torch.autograd.grad(value, x, gradient.reshape(value.shape), create_graph=again)
            return result, None, None
        c = ctx.expansion.coefficients
        a = torch.bmm(c, gradient.double().reshape(len(c), -1, 1)).mT
        return ctx.expansion.stein.scaled_gradient(a, ctx.expansion.sigma).reshape(x.shape).to(x.dtype), None, None
