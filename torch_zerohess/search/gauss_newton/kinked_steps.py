"""Steps for a loss that may have kinks: by a quadratic where it holds, or else by the loss of linear outputs.

A quadratic is wrong at a kink of the loss, and where the curvature of the loss changes along a step. The loss of linear
outputs says so, without an evaluation of the black box. There this loss itself is minimised (`smoothed_minimum`),
within the longest step. It is convex if the loss is, so the shorter steps lead along the same line.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.linalg.smoothed_newton import LinearOutputs, smoothed_minimum
from torch_zerohess.surrogates.loss_curvature import value_and_slope

_EXPANDED, _ROUNDED = 0.5, 1e-12
"""Error of the quadratic's promise, over the promise and over the loss, with which its steps are taken."""
_ROUNDED_UP = 1.0 + 4 * torch.finfo(torch.float64).eps
"""Factor of outputs that changes them by their rounding."""
LITTLE = 1e-5
"""Decrease that the loss of linear outputs promises, over the loss, with which a search has arrived."""
NOTHING = 1e-8
"""Such a decrease that is next to nothing: no step is worth an evaluation."""

Loss = Callable[[Tensor], Tensor]


@dataclass(frozen=True, eq=False)
class Steps:
    """Steps [k, n], and how far the longest one lowers the loss of linear outputs.

    None where a quadratic holds that is curved along this step.
    """

    steps: Tensor
    promised: float | None = None


def holds(before: float, after: float, promised: float, part: float = _EXPANDED) -> bool:
    """Whether the loss of linear outputs falls as a quadratic promises, up to a part of the promise."""
    return abs(before - after - promised) <= part * promised + _ROUNDED * abs(before)


def shortened(s: Tensor, longest: float) -> Tensor:
    """Return a step [n] of at most this length in the same direction."""
    return s * min(1.0, longest / max(float(s.norm()), math.ulp(0.0)))


def linear_outputs(
    loss: Loss, output: Tensor, matvec: Callable[[Tensor], Tensor], rmatvec: Callable[[Tensor], Tensor]
) -> LinearOutputs:
    """Return outputs that are linear in the parameters, with the loss of an output [*out]; see `LinearOutputs`."""

    def valued(y: Tensor) -> tuple[float, Tensor]:
        value, slope = value_and_slope(loss, y.view(output.shape))
        return value, slope.flatten()

    return LinearOutputs(valued, output.flatten(), matvec, rmatvec)


def checked_steps(
    outputs: LinearOutputs,
    steps: Tensor,
    gradient: Tensor,
    bent: Tensor,
    widths: Tensor,
    radii: Tensor,
    lower: Tensor,
    upper: Tensor,
) -> Steps:
    """Return the steps [k, n] of a quadratic where it holds, and else steps to the minimum of linear outputs.

    Args:
        outputs: with their loss.
        steps: within the radii [k], which are in rising order.
        gradient: of the quadratic [n].
        bent: s.Hs of each step [k].
        widths: how far outputs change within the longest radius [m], about.
        radii: [k].
        lower: bounds of steps [n], at most 0.
        upper: at least 0.
    """
    before, down, longest = outputs.value(torch.zeros_like(gradient)), steps @ gradient, float(radii[-1])

    def is_wrong(s: Tensor, promised: float) -> bool:
        after = outputs.value(s)
        if holds(before, after, promised):
            return False
        rounding = abs(outputs.loss(outputs.output * _ROUNDED_UP)[0] - before)
        return abs(before - after - promised) > rounding  # False for NaN

    if not any(is_wrong(s, float(one)) for s, one in zip(steps, -(down + 0.5 * bent), strict=True)):
        straight = float(bent[-1]) <= -_ROUNDED * float(down[-1])
        return Steps(steps, -float(down[-1]) if straight else None)
    start = min(steps.clamp(lower, upper), key=outputs.value)
    end, promised = smoothed_minimum(outputs, widths, longest, lower, upper, start)
    return Steps(radii[:, None] / longest * end, promised)
