"""Methods whose settings are keyword arguments, given as a dictionary."""

from collections.abc import Callable, Mapping
from typing import Any

from experiments.runs.trial import Trial


def with_settings(solve: Callable[..., None], **fixed: Any) -> Callable[[Trial, Mapping[str, Any] | None], None]:
    """Return `solve` as a function of a trial and a dictionary of its other arguments (None: its defaults)."""

    def solve_with(trial: Trial, settings: Mapping[str, Any] | None = None) -> None:
        solve(trial, **fixed, **(settings or {}))

    return solve_with
