"""The black box as a search calls it: what is known stays known, and goes into a memory."""

from torch import Tensor

from torch_zerohess.estimation.advice import add_note
from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.evaluators.batch import numbers as numbers_of
from torch_zerohess.evaluators.inline import Inline
from torch_zerohess.evaluators.partial_values import finished_values
from torch_zerohess.evaluators.returned import ReturnedValueError
from torch_zerohess.minimization.record import Call
from torch_zerohess.surrogates.memory import Memory

_NAMED = 3
"""Points in a note about an error, at most."""


def evaluating(call: BlackBoxCall, memory: Memory | None, *, scalar: bool) -> Call:
    """Return a call that keeps the values of an interrupted batch, those that are known.

    Args:
        call: the black box.
        memory: gets every evaluation; or None.
        scalar: whether each value must be one number. The call raises ValueError for others.
    """

    def evaluated(points: Tensor) -> tuple[list[int], Tensor, BaseException | None]:
        given, failure = points.clone(), None
        before = call.latest
        numbers = list(range(len(points)))
        try:
            values = call(given, ())
        except BaseException as error:  # Ctrl-C, too: the values known so far are kept
            failure = error
            numbers, values = finished_values(error, given)
            if isinstance(error, Exception):
                one_by_one = isinstance(call.evaluator, Inline) and not call.vectorized
                left = [points[k] for k in range(len(points)) if k not in numbers]
                _say_where(error, left[:1] if one_by_one else left)
        if scalar and numbers and values.shape[1:] not in ((), (1,)):
            raise failure or ReturnedValueError(
                f"fn must return one number per point if there is no loss=, got shape {list(values.shape)} for "
                f"{len(points)} points"
            )
        if failure is None and before is not None and values.shape[1:] != before.shape[1:]:
            numbers, failure = (
                [],
                ReturnedValueError(
                    f"fn must return values of one shape, got {list(values.shape[1:])} at the point "
                    f"[{numbers_of(points[0])}] and {list(before.shape[1:])} before"
                ),
            )
        if memory is not None and numbers:
            with memory.lock:
                memory.add(points[numbers], values)
        return numbers, values, failure

    return evaluated


def _say_where(error: Exception, points: list[Tensor]) -> None:
    """Add a note to an error that says at which point [n], or at which of several, fn was."""
    if points:
        places = [f"[{numbers_of(one)}]" for one in points[:_NAMED]] + ["..."] * (len(points) > _NAMED)
        called = f"fn was called at the point{'s' if len(points) > 1 else ''} {', '.join(places)}"
        add_note(error, f"{called}. Where nothing can be computed, let it return NaN: the search avoids such points")
