"""Values of a black box that are not finite: raise, drop the whole antithetic pair, or put a number in their place."""

import math
import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.estimation.inputs import all_finite, short
from torch_zerohess.estimation.stein import Stein
from torch_zerohess.evaluators.batch import numbers
from torch_zerohess.smoothing import Smoothing

_CHANCE = 1e-3
"""Probability at which an element of a batch loses more draws than the others by chance."""
_REGION = (
    "on_nonfinite='drop' drops most draws around a point, where fn fails or is not finite. If fn fails at random, more "
    "samples help. If it fails in a region, derivatives near it are wrong: give a number"
)


def finite_values(
    values: Tensor,
    outputs: Tensor,
    points: Callable[[], Tensor],
    on_nonfinite: str | float,
    K: int,
    smoothing: Smoothing,
    stein: Stein,
    why: Callable[[int, int], str | None] = lambda b, e: None,
) -> tuple[Tensor, Tensor | None]:
    """Treat values [B, E, *out] that are not finite at points [B, E, n], which are asked for where an error names one.

    outputs: of fn [B, E, *outputs]; the values themselves without a head.
    why: why the evaluator has no value of point e of element b; None if fn returned the value.

    Returns the values, and which of the K perturbed rows are kept, [B, K], or None if all are.
    """
    if all_finite(values):
        return values, None
    bad = ~torch.isfinite(values.reshape(*values.shape[:2], -1)).all(2)
    if on_nonfinite != "drop":
        return replaced(values, outputs, bad.nonzero()[0], points(), on_nonfinite, why), None
    kept = ~bad[:, :K]
    if smoothing.antithetic:
        pair = kept[:, : K // 2] & kept[:, K // 2 :]
        kept = torch.cat([pair, pair], 1)
    fewest = 2 if smoothing.baseline == "mean" else 1
    element = int(kept.sum(1).argmin())
    left = int(kept[element].sum()) // (2 if smoothing.antithetic else 1)
    if left < fewest:
        first = element, int(bad[element].nonzero()[0])
        never = (~torch.isfinite(values[element].reshape(len(bad[element]), -1))).all(0)
        numbers_of = f" ({int(never.sum())} of their {len(never)} numbers never are)" if len(never) > 1 else ""
        raise ValueError(
            f"on_nonfinite='drop' left {left} of {smoothing.samples} draws, {fewest} are needed: "
            f"{int(bad[element].sum())} of {bad.shape[1]} values are not finite{numbers_of}; "
            f"{_wrong(values[first], outputs[first], points()[first], why(*first))}"
        )
    if bool(bad[:, K:].any()):
        center = int(bad[:, K].nonzero()[0]), K
        raise ValueError(
            f"{_wrong(values[center], outputs[center], points()[center], why(*center))}, which is x itself. "
            "on_nonfinite='drop' drops perturbed points alone: choose baseline='mean' and value='smoothed', which do "
            "not need f(x), or on_nonfinite=<a number>"
        )
    if not stein.droppable:
        raise ValueError(
            f"on_nonfinite='drop' cannot re-weight the element-wise sets of proposal {smoothing.proposal!r}: give a "
            "number to put in place of values that are not finite"
        )
    if _lost_by_place(kept.sum(1) / K, smoothing.samples):
        warnings.warn(_REGION, stacklevel=2)
    return torch.where(bad.reshape(*bad.shape, *[1] * (values.dim() - 2)), 0.0, values), kept


def _lost_by_place(left: Tensor, draws: int) -> bool:
    """Whether most draws are lost: of all elements together, or of one element by more than chance.

    left: share of the draws that an element keeps [B].
    """
    mean, least = float(left.mean()), float(left.min())
    chance = len(left) * math.exp(-2 * draws * (mean - least) ** 2)  # Hoeffding (1963)
    return mean < 0.5 or (least < 0.5 and chance < _CHANCE)


def replaced(
    values: Tensor,
    outputs: Tensor,
    where: Tensor,
    points: Tensor,
    rule: str | float,
    why: Callable[[int, int], str | None],
) -> Tensor:
    """Put the number `rule` in place of values that are not finite, or raise for the first one, at index `where`.

    why: see `finite_values`. The rule "drop" is for points alone that cannot be dropped.
    """
    if isinstance(rule, str):
        index = tuple(where.tolist())
        wrong = _wrong(values[index], outputs[index], points[index], why(index[0], index[-1] if len(index) > 1 else 0))
        if rule == "drop":
            raise ValueError(f"{wrong}, which is x itself and cannot be dropped: choose on_nonfinite=<a number>")
        raise ValueError(f"{wrong}; choose on_nonfinite='drop' or a number to go on without it")
    # float64, because the number may not exist in the dtype of fn: 1e6 is infinite in float16.
    return torch.where(torch.isfinite(values), values.double(), float(rule))


def _wrong(value: Tensor, output: Tensor, point: Tensor, why: str | None) -> str:
    """Say what fn, or the head after it, returned at a point [n]: the value [*out], from the output [*outputs].

    Or why there is none.
    """
    if why is not None:
        return f"{why}, at the point [{numbers(point)}]"
    value = value.flatten()
    found, where = float(value[~torch.isfinite(value)][0]), f"at the point [{numbers(point)}]"
    if not all_finite(output):
        return f"fn returned {found} {where}"
    size = short(output) if output.numel() <= 1 else f"from {float(output.min()):.4g} to {float(output.max()):.4g}"
    return f"head returned {found} {where}, where the output of fn is finite, {size}: look at head, and at aux if any"
