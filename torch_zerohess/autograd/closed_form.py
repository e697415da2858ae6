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
from torch_zerohess.smoothing import Smoothing

General = Callable[..., Tensor]
"""(expansion, x [B, n], *, center [B, n], zero) -> the expansion around `center` at x, with a graph."""


class ClosedForm(torch.autograd.Function):
    """`apply(x, expansion, smoothing, keep, general)`: the base of the expansion around x, [*batch, *out].

    smoothing, keep: what the expansion was drawn with, see `Expansion.rebuild`.
    general: the same value as a function of x with a graph, for derivatives of the gradient and for `vmap` over it.

    Like `Input`, it saves the input of the black box, x [*batch, n]. All tensors are saved where torch frees them after
    `backward`: a loss that is kept for a report would keep the evaluations otherwise.
    """

    @staticmethod
    def forward(
        ctx: Any, x: Tensor, expansion: Expansion, smoothing: Smoothing, keep: bool, general: General
    ) -> Tensor:
        ctx.save_for_backward(x, *expansion.tensors())
        ctx.smoothing, ctx.keep, ctx.general = smoothing, keep, general
        base = expansion.base.reshape((*x.shape[:-1], *expansion.base.shape[1:]))
        return base.to(x.dtype, copy=True)  # the base may share memory with values

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        x, *tensors = ctx.saved_tensors
        center = x.detach().reshape(-1, x.shape[-1])
        expansion = Expansion.rebuild(tensors, center, ctx.smoothing, ctx.keep)
        again = torch.is_grad_enabled()
        if again or transforms.watched(gradient) or transforms.forward_mode_active():
            with torch.enable_grad():
                with transforms.outside():
                    marked = Input.apply(x)
                value = ctx.general(expansion, marked.reshape(center.shape), center=center, zero=True)
            (result,) = torch.autograd.grad(value, x, gradient.reshape(value.shape), create_graph=again)
            return result, None, None, None, None
        c = expansion.coefficients
        a = torch.bmm(c, gradient.double().reshape(len(c), -1, 1)).mT
        result = expansion.stein.scaled_gradient(a, expansion.sigma).reshape(x.shape).to(x.dtype)
        return result, None, None, None, None
