"""A progress bar that is there from the first second, also where no terminal is."""

import sys
from collections.abc import Iterable, Sized
from typing import Any, TypeVar

from tqdm import tqdm

_Item = TypeVar("_Item")
REFRESH = 0.2 if sys.stderr.isatty() else 30.0
"""Seconds between two changes of a bar: a log file should not fill with it."""


def progress(items: Iterable[_Item], what: str, **more: Any) -> "tqdm[_Item]":
    """Return the items behind a bar that says what they are; `more` is of tqdm."""
    total = len(items) if isinstance(items, Sized) else None
    return tqdm(items, what, total, mininterval=REFRESH, dynamic_ncols=True, **more)
