"""Draw batches until an accuracy is reached."""

import math
from collections.abc import Callable
from typing import Literal

from torch_zerohess.arguments import checked_integer, checked_number
from torch_zerohess.estimation.sums import Sums
from torch_zerohess.smoothing import Smoothing, following_seed

Derivative = Literal["gradient", "hessian_diagonal", "hessian"]
"""Derivatives whose error may end the drawing."""
MOST = 100_000
"""Evaluations that a tolerance may take where no other number is given."""
_ZERO = "; it is 0 in all draws of an element, as on a plateau and at a symmetric minimum: try another sigma"
_NAMES = {"gradient": "gradient", "hessian_diagonal": "diagonal of the Hessian", "hessian": "Hessian"}


def draw_until(
    draw: Callable[[Smoothing], Sums],
    error: Callable[[list[Sums]], tuple[float, bool]],
    smoothing: Smoothing,
    cost: Callable[[Smoothing], int],
    seed: int,
    tolerance: float,
    of: Derivative,
    max_evaluations: int,
) -> tuple[list[Sums], str]:
    """Draw batches, each as large as all before it together, until `error` of them is at most the tolerance.

    Args:
        draw: draws a batch.
        error: relative error of the batches so far, and whether an element has no differences at all.
        smoothing: settings of the first batch; the later ones have a multiple of its samples.
        cost: evaluations of a batch.
        seed: of the first batch.
        tolerance: positive.
        of: the derivative whose error it is.
        max_evaluations: limit of all batches together.

    Returns:
        The batches, and which of the two limits ended it, in a sentence.

    Raises:
        ValueError: the limit does not allow for one batch.
    """
    batches: list[Sums] = []
    used, multiple, name = 0, 0, _NAMES[of]
    while True:
        following = max(1, multiple)
        while following and used + cost(smoothing.replace(samples=following * smoothing.samples)) > max_evaluations:
            following = following // 2
        if not following:
            break
        own = smoothing.replace(samples=following * smoothing.samples, seed=following_seed(seed, len(batches)))
        batches.append(draw(own))
        used, multiple = used + cost(own), multiple + following
        found, flat = error(batches)
        if found <= tolerance:
            reason = f"tolerance: the relative error of the {name} is {found:.2g}, at most {tolerance:g}"
            return batches, reason + (_ZERO if flat else "")
    if not batches:
        raise ValueError(
            f"max_evaluations must be at least {cost(smoothing)}, one batch of the smoothing, got {max_evaluations}"
        )
    return batches, (
        f"max_evaluations: {used} of {max_evaluations} are used, another batch does not fit; the relative error of the "
        f"{name} is {found:.2g}, above the tolerance {tolerance:g}"
    )


def check_limits(tolerance: float | None, of: Derivative, max_evaluations: int | None) -> None:
    """Raise ValueError or TypeError for limits out of their ranges, or for another argument without a tolerance."""
    if of not in _NAMES:
        raise ValueError(f"tolerance_of must be one of {', '.join(map(repr, _NAMES))}, got {of!r}")
    if tolerance is None:
        if of != "gradient":
            raise ValueError(f"tolerance_of says whose error a tolerance is: give tolerance too, got {of!r} alone")
        if max_evaluations is not None:
            raise ValueError(
                f"max_evaluations is the limit of a tolerance: give tolerance too, got {max_evaluations} alone"
            )
        return
    checked_number("tolerance", tolerance, above=0.0, below=math.inf)
    if max_evaluations is not None:
        checked_integer("max_evaluations", max_evaluations)
