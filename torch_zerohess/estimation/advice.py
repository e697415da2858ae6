"""Notes on an error of a black box: how it was called, where that may be the reason."""

import contextlib
import inspect
from collections.abc import Callable, Sequence
from typing import Any

from torch import Tensor


def add_note(error: Exception, text: str) -> None:
    """Add a note to an error; none before Python 3.11, and none to an error that takes no attributes."""
    with contextlib.suppress(Exception):
        error.add_note(text)  # type: ignore[attr-defined, unused-ignore]


def add_advice(
    error: Exception,
    fn: Callable[..., Any],
    points: Tensor,
    aux: Sequence[Tensor],
    *,
    vectorized: bool,
    headed: bool = False,
) -> None:
    """Add a note to an error that fn raised when it was called for a batch of points [K, n].

    A function of one point gets a note only where it mixes arrays and tensors. A class of black boxes with the
    attribute `takes_batches` gets none: its errors are no sign of a function of one point. Neither does an error that
    says what fn must return. With a head (`headed`) fn may have expected the auxiliary inputs that the head gets.
    """
    text = str(error)
    by_construction = getattr(getattr(fn, "__self__", fn), "takes_batches", False)
    if by_construction or text.startswith("fn must return"):
        return
    if "numpy.ndarray" in text and "Tensor" in text:
        add_note(
            error, f"fn gets {'points' if vectorized else 'a point'} as a torch.Tensor: np.asarray(x) is the array"
        )
    missing = isinstance(error, TypeError) and "positional argument" in text
    if headed and missing and not _takes(fn, 1):
        add_note(error, "fn gets points alone where there is a head: the head gets the auxiliary inputs")
        return
    if not vectorized:
        return
    if "does not require grad" in text:
        add_note(
            error, "fn is called under torch.no_grad(): compute what needs derivatives inside under torch.enable_grad()"
        )
        return
    note = f"fn was called with a batch {list(points.shape)}"
    if missing:
        given = [f"points {list(points.shape)}", *(f"aux {list(one.shape)}" for one in aux)]
        note = f"fn was called as fn({', '.join(given)})"
    add_note(error, note + ("; if it takes one point, pass vectorized=False" if _takes(fn, 1 + len(aux)) else ""))


def _takes(fn: Callable[..., Any], count: int) -> bool:
    """Whether fn takes so many arguments; True if nothing is known about it."""
    try:
        inspect.signature(fn).bind(*range(count))
    except TypeError:
        return False
    except ValueError:  # some functions that are written in C
        pass
    return True
