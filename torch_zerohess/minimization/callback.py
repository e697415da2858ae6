"""The callback of a caller, and whether it has asked for the end."""

import math
from collections.abc import Callable

from torch_zerohess.evaluators.returned import ReturnedTypeError
from torch_zerohess.minimization.minimum import Iterate


class Callback:
    """A callback that is called once after every batch."""

    def __init__(self, function: Callable[[Iterate], object]) -> None:
        self._function = function
        self.asked = False
        """Whether it has returned True."""
        self.running = False
        """Whether it is being called, or has raised."""

    def __call__(self, iterate: Iterate) -> None:
        self.running = True
        self.asked = self.asked or _is_true(self._function(iterate))
        self.running = False


def _is_true(answer: object) -> bool:
    """Whether a callback returned True. Other truthy values, such as the count of bytes it wrote, do not end.

    TypeError for several truth values.
    """
    if str(getattr(answer, "dtype", type(answer).__name__)) not in ("bool", "torch.bool"):
        return False
    shape = [*getattr(answer, "shape", ())]
    if math.prod(shape) != 1:
        raise ReturnedTypeError(
            f"callback must return True to end the search, one truth value, got values of shape {shape}: use .any() or "
            ".all()"
        )
    return bool(answer)
