"""A warning where the values of a black box differ by little more than their rounding, so that derivatives are lost."""

import warnings

import torch
from torch import Tensor

_SPACINGS = 2.0
"""Spread of the values around a point, in spacings of their type, up to which they tell of rounding. At this spread the
rounding of a linear function of four parameters adds 60 % to the error of its gradient; at a spread of four, 30 %."""
_FEWEST = 8
"""Values of a call below which they may be so close to each other by chance."""


class RoundingCheck:
    """Looks at the values of calls 1, 2, 4, 8, ... of one black box, and warns once."""

    def __init__(self) -> None:
        self._calls, self._warned = 0, False

    def __call__(self, values: Tensor) -> None:
        """Warn if values [B, E, *out] around B points differ by rounding alone, in a type below float64."""
        self._calls += 1
        if self._calls & (self._calls - 1) or self._warned or values.dtype == torch.float64:
            return
        if text := warning_of(values):
            self._warned = True
            warnings.warn(text, UserWarning, stacklevel=2)


def warning_of(values: Tensor) -> str:
    """Return what to say of values [B, E, *out] that differ by rounding alone; an empty text for all others.

    Equal values are a plateau, unless they are float32 beyond 2^23, which have no fractions. Values that differ by at
    most two spacings are rounded, unless they are integers that the type has between its fractions.
    """
    flat = values.detach().flatten(2) if values.ndim > 2 else values.detach()[..., None]
    if len(flat) * flat.shape[1] < _FEWEST or not flat.numel():
        return ""
    low, high = flat.amin(1).double(), flat.amax(1).double()
    size, spread = torch.maximum(low.abs(), high.abs()), high - low
    spacing = _spacing(size, values.dtype)
    if not bool((spread <= _SPACINGS * spacing).all()):  # as for values that are not finite
        return ""
    coarsest, equal = float(spacing.max()), not bool(spread.any())
    if equal and not (values.dtype == torch.float32 and coarsest >= 1.0):
        return ""
    if not equal and coarsest < 1.0 and bool((flat == flat.round()).all()):
        return ""
    found = (
        "are equal, so derivatives are 0 there"
        if equal
        else "differ by little more than rounding, so derivatives are inexact"
    )
    kind, doubt = str(values.dtype).removeprefix("torch."), "If fn varies by less, compute" if equal else "Compute"
    return (
        f"values of fn at the {flat.shape[1]} points around x {found}: numbers of {kind} lie {coarsest:.3g} apart at "
        f"{float(size.max()):.3g}. {doubt} fn in float64, subtract an offset of its values, or enlarge sigma"
    )


def _spacing(size: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the distance from magnitudes, float64, to the next larger number of a type."""
    limits = torch.finfo(dtype)
    exponent = torch.frexp(size.clamp_min(limits.smallest_normal)).exponent - 1
    return torch.ldexp(torch.full_like(size, limits.eps), exponent)
