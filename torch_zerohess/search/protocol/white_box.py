"""The loss of a caller, as every search calls it."""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.arguments import check_callable

_USUAL = (AttributeError, IndexError, RuntimeError, TypeError, ValueError)
"""What a loss raises that is written for a batch of outputs, for NumPy, or for another type."""


class WhiteBox:
    """A loss of one output [*out], whose error in its first call says that it is the loss, and what it was given.

    The error has the type of what the loss raised, which is its cause. Errors of other types pass, and so do errors of
    a loss that has returned a value before: without a graph, or with one, where it is differentiated.
    """

    def __init__(self, loss: Callable[[Tensor], Tensor]) -> None:
        self._loss, self._answered = loss, set[bool]()

    def __call__(self, output: Tensor) -> Tensor:
        graph = torch.is_grad_enabled()
        try:
            value = self._loss(output)
        except _USUAL as error:
            if type(error) not in _USUAL or graph in self._answered:
                raise
            kind = str(output.dtype).removeprefix("torch.")
            raise type(error)(
                f"loss gets one {kind} output of shape {list(output.shape)}, not a batch, and must compute with "
                f"torch; it raised {type(error).__name__}: {error}"
            ) from error
        self._answered.add(graph)
        return value


def checked_loss(loss: Callable[[Tensor], Tensor] | None) -> WhiteBox | None:
    """Return the loss as a white box; TypeError if it cannot be called."""
    check_callable(loss=loss)
    return None if loss is None else WhiteBox(loss)
