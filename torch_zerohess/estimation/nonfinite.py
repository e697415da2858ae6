"""Values of a black box that are not finite: raise, drop the whole antithetic pair, or put a number in their place."""

from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.estimation.inputs import all_finite
from torch_zerohess.estimation.stein import Stein
from torch_zerohess.evaluators.batch import numbers
from torch_zerohess.smoothing import Smoothing


def finite_values(
    values: Tensor, points: Callable[[], Tensor], on_nonfinite: str | float, K: int, smoothing: Smoothing, stein: Stein
) -> tuple[Tensor, Tensor | None]:
    """Treat values [B, E, *out] that are not finite at points [B, E, n], which are asked for where an error names one.

    Returns the values, and which of the K perturbed rows are kept, [B, K], or None if all are.
    """
    if all_finite(values):
        return values, None
    bad = ~torch.isfinite(values.reshape(*values.shape[:2], -1)).all(2)
    if on_nonfinite != "drop":
        return replaced(values, bad.nonzero()[0], points(), on_nonfinite), None
    if bool(bad[:, K:].any()):
        element = int(bad[:, K].nonzero()[0])
        raise ValueError(
            f"{_wrong(values[element, K], points()[element, K])}, which is x itself. on_nonfinite='drop' drops "
            "perturbed points alone: choose baseline='mean' and value='smoothed', which do not need f(x), or "
            "on_nonfinite=<a number>"
        )
    kept = ~bad[:, :K]
    if smoothing.antithetic:
        pair = kept[:, : K // 2] & kept[:, K // 2 :]
        kept = torch.cat([pair, pair], 1)
    fewest = 2 if smoothing.baseline == "mean" else 1
    left = int(kept.sum(1).min()) // (2 if smoothing.antithetic else 1)
    if left < fewest:
        raise ValueError(
            f"on_nonfinite='drop' left {left} of {smoothing.samples} draws, {fewest} are needed: fn is not finite "
            "almost everywhere around x"
        )
    if not stein.droppable:
        raise ValueError(
            f"on_nonfinite='drop' cannot re-weight the element-wise sets of proposal {smoothing.proposal!r}: give a "
            "number to put in place of values that are not finite"
        )
    return torch.where(bad.reshape(*bad.shape, *[1] * (values.dim() - 2)), 0.0, values), kept


def replaced(values: Tensor, where: Tensor, points: Tensor, rule: str | float) -> Tensor:
    """Put the number `rule` in place of values that are not finite, or raise for the first one, at index `where`."""
    if isinstance(rule, str):
        index = tuple(where.tolist())
        raise ValueError(
            f"{_wrong(values[index], points[index])}; choose on_nonfinite='drop' or a number to go on without it"
        )
    # float64, because the number may not exist in the dtype of fn: 1e6 is infinite in float16.
    return torch.where(torch.isfinite(values), values.double(), float(rule))


def _wrong(value: Tensor, point: Tensor) -> str:
    """Say what fn returned, [*out], at a point [n]."""
    value = value.flatten()
    return f"fn returned {float(value[~torch.isfinite(value)][0])} at the point [{numbers(point)}]"
