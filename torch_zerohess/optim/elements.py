"""Whether each loss of a batch depends on its own element alone."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

_COUPLED = 1e-3
"""Relative error of a derivative at which losses depend on other elements."""
_REPEATED = 8.0
"""The same in differences between two backward passes, which on a GPU may add in another order."""


def check_elements(derivative: Callable[[Tensor], Tensor], image: Tensor) -> None:
    """Raise ValueError if a loss depends on another element.

    The derivative of element b, of the losses times factors c [B], is then not c_b times the one without factors. The
    factors are powers of two, which do not change the rounding. Those of up to 8 elements differ.

    Args:
        derivative: factors [B] -> gradient or product of the Hessians [B, n].
        image: the derivative without factors, [B, n].
    """
    B = len(image)
    if B == 1:
        return
    c = (0.5 ** (torch.randperm(B, generator=torch.Generator().manual_seed(1), device="cpu") % 8)).to(image)
    scaled, ones = derivative(c) / c[:, None], torch.ones_like(c)
    least = torch.finfo(image.dtype).tiny * math.sqrt(image.numel())  # half precision: factors lose what is below it

    def norm(x: Tensor) -> float:
        return float(x.double().norm())

    if norm(scaled - image) <= max(least, _COUPLED * norm(image)):
        return
    image, again = derivative(ones), derivative(ones)  # rounding that differs from pass to pass, and of the image
    if norm(scaled - image) > max(least, _COUPLED * norm(image), _REPEATED * norm(again - image)):
        raise ValueError(
            "losses(y) must be each of its own element of the batch, but one depends on the outputs of another: leave "
            "out what couples them, such as a mean over the batch"
        )
