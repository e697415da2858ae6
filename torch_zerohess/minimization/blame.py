"""Whose error an exception of a minimisation is."""

import torch

_NUMERICAL = torch.linalg.LinAlgError  # type: ignore[attr-defined]
_OWN = tuple(f"torch_zerohess.{folder}." for folder in ("search", "surrogates", "linalg"))
"""Beginnings of the names of modules with models of a search."""


def blamed(error: BaseException, caller: str) -> str:
    """Return "the search" for a numerical failure of its own models, else `caller`, the name of a caller's function."""
    trace = error.__traceback__
    while trace is not None and trace.tb_next is not None:
        trace = trace.tb_next
    module = "" if trace is None else str(trace.tb_frame.f_globals.get("__name__"))
    return "the search" if isinstance(error, _NUMERICAL) and module.startswith(_OWN) else caller
