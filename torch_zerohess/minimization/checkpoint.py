"""The file of a search: never half written, and never in the way of the result."""

import contextlib
import os
import threading
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import torch


class Checkpoint:
    """A file that a search is written to, and read from when it goes on."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._warned = set[str]()
        """What has been warned of: each once."""
        self._own: tuple[tuple[int, int] | None, ...] = (None,)
        """States of the file that are due to this run: before and after its last write, which may be interrupted."""

    @property
    def exists(self) -> bool:
        """Whether there is a file to go on from."""
        return self._path.exists()

    def read(self) -> Any:
        """Return what is in the file. ValueError if torch cannot read it."""
        self._own = (_state(self._path),)
        try:
            return torch.load(self._path, map_location="cpu", weights_only=True)
        except Exception as error:  # it raises any, for a file of another kind
            raise ValueError(self._wrong(f"torch.load cannot read it ({type(error).__name__})")) from error

    @contextlib.contextmanager
    def going_on(self) -> Iterator[None]:
        """Name the file in an error about what is in it."""
        try:
            yield
        except Exception as error:
            name = "" if isinstance(error, ValueError | KeyError) else f"{type(error).__name__}: "
            raise ValueError(self._wrong(f"{name}{str(*error.args[:1])[:300]}")) from error

    def write(self, content: dict[str, Any]) -> None:
        """Write the file; a `UserWarning` if it cannot be written, or if another process writes it, too."""
        found = _state(self._path)
        if found is not None and found not in self._own:
            self._warn("has changed since this search read or wrote it: another process writes it, too")
        # No other process or thread has this name.
        draft = self._path.with_name(f"{self._path.name}.{os.getpid()}.{threading.get_ident()}.part")
        try:
            with draft.open("wb") as file:
                torch.save(content, file)
                file.flush()
                os.fsync(file.fileno())  # after a power cut, the name may otherwise be that of an empty file
            self._own = (found, _state(draft))
            draft.replace(self._path)
        except BaseException as error:  # Ctrl-C, too
            with contextlib.suppress(OSError):
                draft.unlink(missing_ok=True)
            if not isinstance(error, Exception):
                raise
            self._warn("cannot be written, the search goes on without it", f": {type(error).__name__}: {error}")

    def _wrong(self, message: str) -> str:
        return (
            f"checkpoint must be a new file, or one that minimize wrote with the same settings, got {self._path}: "
            f"{message}"
        )

    def _warn(self, what: str, more: str = "") -> None:
        """Warn once of what is wrong with the file."""
        if what not in self._warned:
            self._warned.add(what)
            warnings.warn(f"checkpoint {str(self._path)!r} {what}{more}", UserWarning, stacklevel=2)


def check_limits(given: Mapping[str, float | None], before: Mapping[str, float | None], end: str) -> None:
    """Raise ValueError for a limit that differs from the one before, with which the search has come to its end."""
    for name, value in given.items():
        if value != before[name]:
            raise ValueError(
                f"{name} must be {before[name]} as there, where the search is done ({end}), got {value}: minimise from "
                f"its x with a new file"
            )


def _state(path: Path) -> tuple[int, int] | None:
    """Return when a file was changed, in ns, and its size; None if there is none."""
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_size
