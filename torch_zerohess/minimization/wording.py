"""Why a search has ended, in words, with what its evaluations say about the end."""

from torch import Tensor

from torch_zerohess.minimization.minimum import Status

_NAMED = 5
"""Parameters in a message that are named, at most."""
NARROW = 1e-4
"""Sigma of a parameter over the distance between its bounds, below which the message warns of it."""
REMEDY = "enlarge sigma, or check that x changes fn"
"""What to do where all outputs are equal."""


def worded(
    message: str,
    status: Status,
    equal: int,
    doubt: str,
    untouched: Tensor | None,
    *,
    arrived: bool,
    success: bool,
    flat: bool = False,
    measuring: int = 0,
    failed: int = 0,
    same_outputs: bool = False,
    found: int = 0,
    evaluations: int = 0,
    at_bounds: Tensor | None = None,
    narrow: Tensor | None = None,
) -> str:
    """Return the message of a result.

    Args:
        message: why the search ended.
        status: of the result.
        equal: how many evaluations there were, if all values are equal; otherwise 0.
        doubt: why x may be no minimum; empty if there is no doubt.
        untouched: which parameters no output was found to depend on, bools [n]; or None.
        arrived: whether the search has arrived at x.
        success: of the result.
        flat: whether the loss hardly changes along some direction.
        measuring: evaluations with which noise would have been measured; 0 if it was, or was given.
        failed: evaluations whose values are not finite.
        same_outputs: whether all outputs are known to be equal.
        found: number of the evaluation that found x, from 1; 0 if there is none, as in noise.
        evaluations: how many there were.
        at_bounds: which parameters of x lie at a bound, bools [n]; or None.
        narrow: which parameters have a sigma that is far too small for their bounds, bools [n]; or None.
    """
    cut = status in ("budget", "time")
    if equal and same_outputs:
        message += f"; all {equal} outputs are equal: {REMEDY}"
    elif equal and status != "target":
        message += f"; all {equal} values are equal: enlarge sigma"
    elif (status == "stalled" or (cut and (arrived or failed))) and doubt not in message:
        message += f"; {doubt}"
    if success and cut:
        message += "; the search had arrived at x, a minimum at least of its surroundings"
    if cut and found and not equal:
        message += f"; x was found by evaluation {found} of {evaluations}"
    if flat and success and status != "target" and "not unique" not in message:
        message += "; along some direction the loss hardly changes: the minimum may not be unique"
    if measuring:
        message += f"; noise was not measured: give noise, or max_evaluations of at least {measuring}"
    if failed:
        message += f"; values or outputs that are not finite, and were left out: {failed}"
        if status == "stalled":
            message += "; let fn return a loss that grows with the violation, or outputs, with a penalty in loss="
    if status not in ("target", "failed"):
        message += _on(at_bounds, "lie at a bound")
        message += _on(narrow, f"have a sigma below {NARROW:g} of the distance between their bounds: enlarge sigma")
    return message + _on(untouched, "were not found to change any output, and stay")


def budget(most: int, count: int, *, rest: bool) -> str:
    """Return why there is no further step after `count` evaluations of `most`; `rest`: although some may be left."""
    given = f"max_evaluations ({most})"
    if count > most:
        return f"{given} allows no more than the {count} so far"
    return f"{given} allows no step after the {count} so far" if rest and count < most else f"{given} used up"


def _on(which: Tensor | None, what: str) -> str:
    """Return what holds for some parameters, bools [n], with the numbers of the first of them."""
    numbers = [] if which is None else which.nonzero()[:, 0].tolist()
    if which is None or not numbers:
        return ""
    names = ", ".join(map(str, numbers[:_NAMED])) + (", ..." if len(numbers) > _NAMED else "")
    return f"; {len(numbers)} of {len(which)} parameters ({names}) {what}"
