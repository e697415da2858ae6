"""Where evaluations show that a function is constant around a point."""

from torch import Tensor

_PART = 0.25
"""Part of the evaluations around a point that have exactly its value, from which it lies on a plateau."""


def is_plateau(distance: Tensor, values: Tensor, value: float, *, beyond: float) -> bool:
    """Whether a part of the evaluations around a point has exactly its value, out to some distance.

    In a valley few do: those on its floor.

    Args:
        distance: of the evaluations from the point [P].
        values: [P].
        value: at the point.
        beyond: distance up to which equal values may be due to rounding.
    """
    around = distance > beyond
    distance, order = distance[around].sort()
    equal = values[around][order] == value
    count = equal.cumsum(0)
    return bool((equal & (count >= _PART * count.new_ones(len(count)).cumsum(0))).any())
