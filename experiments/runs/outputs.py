"""Where a command may write, checked before it measures anything."""

import os
import tempfile
from pathlib import Path


def check_folder(out: Path) -> None:
    """SystemExit if a folder cannot be made here, or no file in it. Nothing is left behind."""
    reason = _refusal(out)
    if reason is not None:
        raise SystemExit(f"out must be a folder that can be written, got {out}: {reason}")


def check_file(out: Path | None) -> None:
    """SystemExit if a file cannot be written here. None is no file to write."""
    if out is None:
        return
    reason = "Is a directory" if out.is_dir() else _refusal(out.parent)
    if reason is not None:
        raise SystemExit(f"out must be a file that can be written, got {out}: {reason}")


def _refusal(folder: Path) -> str | None:
    """Return why no file can be made in a folder, which need not exist yet; None if one can."""
    try:
        with tempfile.TemporaryFile(dir=_nearest(folder.absolute())):
            return None
    except OSError as error:
        return error.strerror


def _nearest(path: Path) -> Path:
    """Return a path, or what exists nearest above it."""
    try:
        os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return _nearest(path.parent)
    return path
