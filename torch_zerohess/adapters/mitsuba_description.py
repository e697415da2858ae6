"""The description of a Mitsuba scene, and the scene that is loaded from it."""

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import ModuleType
from typing import Any

Description = Mapping[str, Any] | str | os.PathLike[str] | Callable[[ModuleType], Mapping[str, Any]]


def described(mi: Any, description: Description) -> dict[str, Any] | Path:
    """Return what `load_dict` takes, or the path of a file that exists."""
    if not isinstance(description, (str, os.PathLike)):
        return dict(description(mi) if callable(description) else description)
    path = Path(description)
    if not path.is_file():
        raise FileNotFoundError(f"description: there is no file {path}")
    return path


def loaded(mi: Any, description: dict[str, Any] | Path) -> Any:
    """Return the scene; `optimize=False` keeps the names of the parameters."""
    try:
        if isinstance(description, Path):
            return mi.load_file(str(description), optimize=False)
        return mi.load_dict(description, optimize=False)
    except RuntimeError as error:
        if "No such file" in str(error) or "does not exist" in str(error):
            raise FileNotFoundError(f"description: {error}") from error
        raise
