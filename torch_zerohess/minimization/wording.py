"""Why a search has ended, in words, with what its evaluations say about the end."""

from torch_zerohess.minimization.minimum import Status


def worded(message: str, status: Status, equal: int, doubt: str, *, arrived: bool, success: bool) -> str:
    """Return the message of a result.

    Args:
        message: why the search ended.
        status: of the result.
        equal: how many evaluations there were, if all values are equal; otherwise 0.
        doubt: why x may be no minimum; empty if there is no doubt.
        arrived: whether the search has arrived at x.
        success: of the result.
    """
    cut = status in ("budget", "time")
    if equal and status != "target":
        message += f"; all {equal} values are equal: enlarge sigma"
    elif (status == "stalled" or (arrived and cut)) and doubt not in message:
        message += f"; {doubt}"
    if success and cut:
        message += "; the search had arrived at x, a minimum at least of its surroundings"
    return message


def budget(most: int, count: int, *, rest: bool) -> str:
    """Return why there is no further step after `count` evaluations of `most`; `rest`: although some may be left."""
    given = f"max_evaluations ({most})"
    if count > most:
        return f"{given} allows no more than the {count} so far"
    return f"{given} allows no step after the {count} so far" if rest and count < most else f"{given} used up"
