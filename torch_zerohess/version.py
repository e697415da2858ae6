"""The version of this package, for the states that it writes."""

import importlib.metadata
from collections.abc import Mapping
from typing import Any


def installed_version(package: str) -> str | None:
    """Return the version of an installed package, by its name on PyPI; None if it is not installed."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


VERSION = installed_version("torch_zerohess") or "unknown"


def written_by(state: Mapping[str, Any]) -> str:
    """Say which version wrote a state that this one cannot read."""
    own = f"this is torch_zerohess {VERSION}"
    return f"written by version {state['version']}, {own}" if "version" in state else f"without a version, {own}"
