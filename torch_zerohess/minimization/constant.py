"""Warnings about what a search cannot follow, long before the evaluations end: constants, and steps of a loss."""

import warnings
from collections.abc import Callable

import torch
from torch import Tensor

from torch_zerohess.minimization.record import Record
from torch_zerohess.minimization.wording import REMEDY
from torch_zerohess.surrogates.loss_curvature import value_and_slope

_MANY = 50
"""Evaluations after which equal values are a warning. If the value differed at one point of seventeen, fifty equal
values would have a probability of 5 %."""
_SEVERAL = 20
"""Evaluations after which losses that differ, and all have a slope of zero, are a warning."""
_FEWEST = 5
"""Outputs that say so, at least: of large images not all are kept."""


def warn_of_constant(record: Record, before: int) -> None:
    """Warn once, when the record reaches fifty evaluations, if all values are equal to the last bit.

    before: number of evaluations before the latest batch.
    """
    if not before < _MANY <= record.complete or not record.flat:
        return
    if record.has_outputs and not record.same_outputs:
        said = "values are equal so far, although outputs differ: enlarge sigma, or check that loss depends on them"
    else:
        said = f"{'outputs' if record.has_outputs else 'values'} are equal so far: {REMEDY}"
    warnings.warn(f"all {record.complete} {said}", UserWarning, stacklevel=5)


def warn_of_steps(record: Record, loss: Callable[[Tensor], Tensor] | None) -> None:
    """Warn once, when the record reaches twenty evaluations, if losses differ and no output has a slope of its loss.

    Such a loss thresholds or rounds. A search with `loss` follows its derivatives by the output, and learns nothing.

    loss: of one output [*out]; None if values are losses.
    """
    if record.complete < _SEVERAL or record.early is None:
        return
    outputs, record.early = [one.double() for one in record.early if bool(torch.isfinite(one).all())], None
    if loss is None or record.flat or not record.has_outputs or len(outputs) < _FEWEST:
        return
    values = set()
    for one in outputs:
        try:
            value, slope = value_and_slope(loss, one)
        except Exception:  # of a loss that has no derivative at an output that no step has needed
            return
        if bool(slope.any()):
            return
        values.add(value)
    if len(values) > 1:
        warnings.warn(
            f"loss has a derivative of zero at all {len(outputs)} outputs so far, although its values differ, as if it "
            "thresholds or rounds: let the black box return the loss, and give no loss=",
            UserWarning,
            stacklevel=5,
        )
