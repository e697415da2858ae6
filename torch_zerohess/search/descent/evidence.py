"""Evidence for a second model of the loss: how much better it has predicted the latest losses than the first one."""

import math
from collections.abc import Callable

from torch import Tensor

from torch_zerohess.search.descent.metric_progress import MetricProgress
from torch_zerohess.search.protocol.state import Evaluated

Change = Callable[[Tensor], float]
"""Change of the loss by a step [n] from the best point, according to a model."""

_FADING, _LARGEST = 0.8, 2.0
"""The evidence is a sum over evaluations of log(error of the first model / error of the second one). Each term is at
most the second number in magnitude. Each new term multiplies the sum so far by the first number."""
_ROUNDING, _SMALLEST = 1e-14, 1e-300
"""Error of a prediction that is rounding, relative to the loss, and at a loss of 0."""


def weighed(evidence: float, known: MetricProgress, evaluated: Evaluated, first: Change, second: Change) -> float:
    """Return the evidence after the loss at the point that was needed, if models have predicted it."""
    if known.wide is not None or known.phase not in ("trial", "geometry") or not bool(evaluated.finite[0]):
        return evidence
    best = known.lowest
    step, told = evaluated.points[0] - best.point, float(evaluated.losses[0]) - best.loss
    rounding = _ROUNDING * abs(best.loss) + _SMALLEST
    gain = math.log(abs(told - first(step)) + rounding) - math.log(abs(told - second(step)) + rounding)
    return _FADING * evidence + min(max(gain, -_LARGEST), _LARGEST)
