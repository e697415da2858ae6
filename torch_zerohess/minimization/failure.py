"""Whose error an exception of a minimisation is, in words."""

import torch

from torch_zerohess.evaluators.returned import ReturnedError

_NUMERICAL = torch.linalg.LinAlgError  # type: ignore[attr-defined]
_OWN = tuple(f"torch_zerohess.{folder}." for folder in ("search", "surrogates", "linalg"))
"""Beginnings of the names of modules with models of a search."""


def failure(error: BaseException, caller: str) -> str:
    """Return who raised an error: "the search" for a numerical failure of its own models, or a function of the caller.

    The message of a check of what such a function returned is returned as it is.

    Args:
        error: with its traceback.
        caller: name of the function.
    """
    if isinstance(error, ReturnedError):
        return str(error)
    own = isinstance(error, _NUMERICAL) and _raising(error).startswith(_OWN)
    return f"{'the search' if own else caller} raised {error!r}"


def _raising(error: BaseException) -> str:
    """Return the name of the module that raised an error."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
