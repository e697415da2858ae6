"""Whose error an exception of a minimisation is, in words."""

import torch

_NUMERICAL = torch.linalg.LinAlgError  # type: ignore[attr-defined]
_OWN = tuple(f"torch_zerohess.{folder}." for folder in ("search", "surrogates", "linalg"))
"""Beginnings of the names of modules with models of a search."""
_CHECKS = tuple(
    f"torch_zerohess.{module}"
    for module in (
        "evaluators.values",
        "minimization.callback",
        "minimization.evaluating",
        "minimization.separate",
        "search.protocol.told_values",
        "search.sparse.progress",
    )
)
"""Modules that check what functions of a caller return."""


def failure(error: BaseException, caller: str) -> str:
    """Return who raised an error: "the search" for a numerical failure of its own models, or a function of the caller.

    What a check raises of a value that such a function returned speaks for itself.

    Args:
        error: with its traceback.
        caller: name of the function.
    """
    module = _raising(error)
    if module in _CHECKS and isinstance(error, TypeError | ValueError):
        return str(error)
    own = isinstance(error, _NUMERICAL) and module.startswith(_OWN)
    return f"{'the search' if own else caller} raised {error!r}"


def _raising(error: BaseException) -> str:
    """Return the name of the module that raised an error."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    return "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
