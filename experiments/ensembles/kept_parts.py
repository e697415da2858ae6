"""Rows of a study in a file that grows: a study that was stopped goes on where it was, as `run` does."""

import json
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

from experiments.ensembles import provenance
from experiments.runs.outputs import check_folder

NAME = "parts.jsonl"
Row = TypeVar("Row")


class KeptParts:
    """Parts of a study: each has a name, all settings that its rows depend on, and is measured once by the same code.

    FOLDER/parts.jsonl has one line per part, written as soon as the part is measured, with the version of the code. A
    part of other code is measured again, and so is one whose line a kill has cut off. FOLDER/command.json has the
    commands.

    Args:
        folder: of the study; made by the first part that is measured. SystemExit if it cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        check_folder(folder)
        self._path = folder / NAME
        self._noted = False
        self._code = provenance.version()
        self._known: dict[str, list[dict[str, Any]]] = {}
        whole = 0
        for line in self._path.read_bytes().splitlines(keepends=True) if self._path.exists() else ():
            try:
                if not line.endswith(b"\n"):
                    break
                part = json.loads(line)
                self._known[_key(part["name"], part.get("code"))] = part["rows"]
            except (ValueError, TypeError, KeyError):
                raise SystemExit(f"{self._path} has a line that is not a part of a study; delete the file") from None
            whole += len(line)
        if self._path.exists():
            with self._path.open("r+b") as file:
                file.truncate(whole)

    def rows(self, name: Mapping[str, Any], of: type[Row], measure: Callable[[], Iterable[Row]]) -> list[Row]:
        """Return the rows of a part, from the file or measured now and written to the file.

        Args:
            name: settings by name, as JSON can hold them.
            of: dataclass of the rows.
            measure: returns the rows.
        """
        key = _key(name, self._code)
        if key not in self._known:
            found = [asdict(row) for row in measure()]  # type: ignore[call-overload]
            self._append({"name": dict(name), "code": self._code, "rows": found})
            self._known[key] = found
        return [of(**row) for row in self._known[key]]

    def _append(self, part: Mapping[str, Any]) -> None:
        self._path.parent.mkdir(parents=True, exist_ok=True)
        if not self._noted:
            provenance.register(self._path.parent, {})
            self._noted = True
        with self._path.open("ab") as file:
            file.write(json.dumps(part).encode() + b"\n")


def _key(name: Mapping[str, Any], code: Mapping[str, Any] | None) -> str:
    return json.dumps([name, code], sort_keys=True)
