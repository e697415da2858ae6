"""Methods whose settings are keyword arguments, given as a dictionary."""

from collections.abc import Callable, Mapping
from typing import Any


def with_settings(solve: Callable[..., object], **fixed: Any) -> Callable[[Any, Mapping[str, Any] | None], None]:
    """Return `solve` as a function of a trial and a dictionary of its other arguments (None: its defaults)."""

    def solve_with(trial: Any, settings: Mapping[str, Any] | None = None) -> None:
        solve(trial, **fixed, **(settings or {}))

    return solve_with
