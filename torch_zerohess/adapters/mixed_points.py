"""Does the value of a point depend on the other points of its call? Then it is no function of the point."""

import math
from collections.abc import Callable

import torch
from torch import Tensor

_ROUNDING = 0.05
"""Share of the values that may change: a model may round to 8 bits, with limits of the whole batch."""


class MixedPoints:
    """A check that is made once."""

    def __init__(self) -> None:
        self.checked = False

    def check(self, output: str, x: Tensor, values: Tensor, alone: Callable[[int], Tensor]) -> None:
        """Raise ValueError if the point of the largest of values [K, *out] has another one by itself.

        alone: returns the value of the point with a number, [1, *out] or another shape of as many numbers. There is no
            conclusion where it differs from time to time, as with random numbers, or where a single point cannot be
            evaluated.
        """
        if self.checked or bool((x == x[:1]).all()) or not bool(values.isfinite().all()):
            return
        sizes = values.double().reshape(len(values), math.prod(values.shape[1:])).norm(dim=1)
        k = int(sizes.argmax())
        try:
            one, again = alone(k).double(), alone(k).double()
        except Exception:  # of whatever kind: the model may need several points
            self.checked = True
            return
        if torch.equal(one, again):
            if one.numel() != values[k].numel():
                raise ValueError(
                    f"output {output!r} must have one value per point, but is {list(values.shape)} for {len(x)} points "
                    f"and {list(one.shape)} for one of them alone. Export the model with the batch as dimension 0 of "
                    "the output, or for a batch of 1"
                )
            change = float((one.flatten() - values[k].double().flatten()).norm())
            if not change <= _ROUNDING * float(sizes[k]):
                raise ValueError(
                    f"output {output!r} must depend on its own point alone, but the value of a point changes by "
                    f"{change:g} of {float(sizes[k]):g} where it is alone: the model mixes the points of a batch, as "
                    "a BatchNorm in training mode or a Softmax over dimension 0 does, or the batch is not dimension 0 "
                    "of the output. Export it for evaluation, or for a batch of 1"
                )
        self.checked = True
