"""Where a black box begins in a graph."""

from typing import Any

import torch
from torch import Tensor


class Input(torch.autograd.Function):
    """The identity. It marks in the graph where a black box begins: see `graph.black_box_inputs`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient
