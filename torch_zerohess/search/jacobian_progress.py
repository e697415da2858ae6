"""What a search by Gauss-Newton steps knows: it asks for samples that tell the Jacobian of an output, or for steps."""

from dataclasses import dataclass, replace
from typing import Literal, TypeVar

from torch import Tensor

from torch_zerohess.search.state import Evaluated, Progress

_ENDLESS = 10
"""Batches in a row with values that are not finite, after which the search ends."""

Q = TypeVar("Q", bound="JacobianProgress")


@dataclass(frozen=True, eq=False, kw_only=True)
class JacobianProgress(Progress):
    """An output, and what is asked for to go on. A search adds the Jacobian there."""

    phase: Literal["sample", "trial"] = "sample"
    """What is asked for: samples, after the start itself at first, or steps."""
    radius: float
    """Root mean square over the parameters."""
    output: Tensor
    """At the center [m], float64; empty before the first values."""
    refused: int = 0
    """Batches in a row without a finite value."""

    def counted(self: Q, evaluated: Evaluated) -> Q:
        """Return what is known with a batch counted; it is done after too many batches without a finite value."""
        refused = 0 if bool(evaluated.finite.any()) else self.refused + 1
        known = replace(self, shape=evaluated.shape, evaluations=self.evaluations + len(evaluated), refused=refused)
        if refused < _ENDLESS:
            return known
        return replace(known, done=True, message=f"{_ENDLESS} batches in a row had no finite value")
