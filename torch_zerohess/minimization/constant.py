"""A warning about a black box that seems not to depend on x, long before the evaluations are used up."""

import warnings

from torch_zerohess.minimization.record import Record
from torch_zerohess.minimization.wording import REMEDY

_MANY = 50
"""Evaluations after which equal values are a warning. If the value differed at one point of seventeen, fifty equal
values would have a probability of 5 %."""


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
