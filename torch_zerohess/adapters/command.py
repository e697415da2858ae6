"""The command of a program: is it one, is there such a program, and what does it find around it."""

import os
import shutil
from collections.abc import Mapping, Sequence
from typing import Any


def checked_environment(environment: Any) -> dict[str, str] | None:
    """Return variables as a dictionary; TypeError if they are no mapping of text to text."""
    if environment is None:
        return None
    if not isinstance(environment, Mapping):
        raise TypeError(f"environment must be a mapping of names to text, got {environment!r}")
    for name, value in environment.items():
        if not isinstance(name, str) or not isinstance(value, str):
            raise TypeError(f"environment must map names to text, got {name!r}: {value!r}")
    return dict(environment)


def found_program(command: Sequence[str], folder: str | None, environment: Mapping[str, str] | None) -> Sequence[str]:
    """Return a command whose program exists; TypeError if it is text, which a function may return by mistake.

    A path of the program is relative to the folder where it runs, a name alone is looked for in the PATH that it gets.
    So are the folders in this PATH, because the program starts from there.
    """
    if isinstance(command, str) or not isinstance(command, Sequence) or not command:
        raise TypeError(f"command must return a list, the program and its arguments, got {command!r}")
    wrong = [one for one in command if not isinstance(one, (str, bytes, os.PathLike))]
    if wrong:
        raise TypeError(f"command must be a list of texts and paths, got {wrong[0]!r} in it: write str({wrong[0]!r})")
    name = os.fsdecode(command[0])
    place = os.path.join(folder or "", name) if os.path.dirname(name) else name
    folders = (os.environ | (environment or {})).get("PATH", os.defpath).split(os.pathsep)
    if shutil.which(place, path=os.pathsep.join(os.path.join(folder or "", one) for one in folders)) is None:
        raise FileNotFoundError(
            f"command: there is no program {name!r} that could be run, see "
            + ("PATH" if place == name else f"folder {os.fspath(folder or '')!r}")
        )
    return command
