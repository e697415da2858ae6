"""Two outputs of a search with their losses, which tell whether it goes on with the loss that it had."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.search.protocol.state import Evaluated
from torch_zerohess.search.protocol.told_values import as_evaluated

_ROUNDING = 1e-4
"""Relative difference of two losses that may be rounding: networks in float32 have it on another machine."""
_CANCELLED = 1e-7
"""The same, over the larger loss of the reference: a loss near zero may be a difference of large numbers."""


@dataclass(frozen=True, eq=False)
class Reference:
    """The first and the lowest evaluation of a search: outputs [2, *out] and their losses [2].

    Two losses may agree at one of them: where both are zero there, or by symmetry.
    """

    outputs: Tensor
    losses: Tensor

    def check(self, loss: Callable[[Tensor], Tensor]) -> None:
        """Raise ValueError for a loss of which the outputs have other losses. A loss that is random tells nothing."""
        found = self._by(loss)
        if self._agree(found, self.losses) or not self._agree(self._by(loss), found):
            return
        k = int((found - self.losses).abs().nan_to_num(nan=torch.inf).argmax())
        raise ValueError(
            f"loss must be that of the saved search, which was {float(self.losses[k]):g} for one of its outputs, got "
            f"one that is {float(found[k]):g} there: begin a new search for another loss"
        )

    def _by(self, loss: Callable[[Tensor], Tensor]) -> Tensor:
        return as_evaluated(self.outputs, self.losses, loss, torch.Size()).losses

    def _agree(self, one: Tensor, other: Tensor) -> bool:
        least = _CANCELLED * float(self.losses.abs().max())
        return torch.allclose(one, other, rtol=_ROUNDING, atol=least, equal_nan=True)


def reference(before: Reference | None, told: Evaluated) -> Reference | None:
    """Return the reference after an evaluation; None where the black box returns the loss, or no value is finite."""
    if told.outputs is None:
        return None
    losses = torch.where(told.finite, told.losses, torch.inf)
    lowest = losses.argmin()
    if not losses[lowest] < (torch.inf if before is None else before.losses[1]):
        return before
    outputs = told.outputs.reshape(len(told), *told.shape)
    first = told.finite.long().argmax()
    start = (outputs[first], losses[first]) if before is None else (before.outputs[0], before.losses[0])
    return Reference(torch.stack([start[0], outputs[lowest]]), torch.stack([start[1], losses[lowest]]))
