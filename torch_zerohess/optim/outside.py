"""Whether the gradient of a loss is J^T g, with the slopes g at the inputs of black boxes; and if not, why."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_zerohess.autograd.blocks import jacobian as white_box_jacobian
from torch_zerohess.autograd.curvature import CurvatureOperator
from torch_zerohess.autograd.graph import check_twice
from torch_zerohess.linalg.flat import flattened
from torch_zerohess.linalg.jacobians import Jacobian, Rows

_OUTSIDE = 1e-4
"""Part of a gradient that may come from elsewhere than the inputs of black boxes, for the dual solve: rounding."""


def check_inside(J: Jacobian, operators: Sequence[CurvatureOperator], gradient: Tensor, *, sampled: bool) -> Tensor:
    """Return the mean slopes g [M], float64; ValueError if the gradient [N] is not J^T g, with the one cause;
    RuntimeError if a compiled backward is the cause.

    Args:
        J: of the M inputs of black boxes by the N parameters.
        operators: of the losses whose mean has this gradient.
        gradient: of the loss, [N].
        sampled: whether J is of a `SampleJacobian`.
    """
    g = torch.stack([flattened(one.output_gradient) for one in operators]).double().mean(0)
    if _is(gradient, J.rmatvec(g)):
        return g
    for one in operators:  # torch may get another result from the second pass through a compiled backward
        check_twice(one.through, one.inputs)
    # One backward pass from the inputs of the black boxes, whose rounding is the same as the rounding of the gradient.
    pulled = torch.stack([one.pull(one.output_gradient) for one in operators]).double().mean(0)
    if not _is(gradient, pulled):
        cause = (
            "needs a loss that depends on the parameters through the inputs of black boxes alone, got one that also "
            "depends on them in another way, such as a penalty of the weights: use solver 'steihaug' or 'clip'"
        )
    elif sampled and _is(gradient, Rows(white_box_jacobian(operators[0])).rmatvec(g)):
        cause = "needs a SampleJacobian of the batch of the loss, with its samples in the same order, got another order"
    else:
        cause = (
            "needs a network in single or double precision, got one whose Jacobian is rounded by more than "
            f"{_OUTSIDE}, as in bfloat16: call the network outside of torch.autocast, or use solver 'steihaug' or "
            "'clip'"
        )
    raise ValueError(f"solver 'dual' {cause}")


def _is(gradient: Tensor, other: Tensor) -> bool:
    return float((gradient - other.double()).norm()) <= _OUTSIDE * float(gradient.norm())
