"""What a run leaves on disk: a log with one JSON line per iteration, and its outcome."""

import json
import os
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Literal

Status = Literal["finished", "stopped", "time limit", "failed"]


@dataclass(frozen=True)
class Record:
    """State of a run after an iteration. Errors are mean squares; `None` where a row does not have one."""

    task: str
    method: str
    run: int
    iteration: int
    seconds: float
    """Wall-clock time since the start of the run; measuring errors and writing files are not counted."""
    evaluations: int
    """Black-box evaluations since the start of the run."""
    sigma: float | None
    loss: float | None
    image_error: float | None
    parameter_error: float | None


@dataclass(frozen=True)
class Outcome:
    """How a run ended: both errors small enough (finished), the method or its budget at an end (stopped), or worse."""

    task: str
    method: str
    run: int
    status: Status
    reason: str
    seconds: float
    black_box_seconds: float
    evaluations: int
    iterations: int
    x: list[float]
    """What the method reported last; empty for the weights of a network."""
    settings: dict[str, Any] = field(default_factory=dict)
    traceback: str | None = None

    @property
    def overhead(self) -> float | None:
        """Seconds per iteration outside of the black box."""
        return (self.seconds - self.black_box_seconds) / self.iterations if self.iterations else None


@dataclass(frozen=True)
class Files:
    """Where the files of one run are."""

    folder: Path
    """Of the method: DIR/TASK/METHOD."""
    run: int

    @property
    def log(self) -> Path:
        return self.folder / f"{self.run}.jsonl"

    @property
    def outcome(self) -> Path:
        return self.folder / f"{self.run}.json"

    @property
    def journal(self) -> Path:
        """Exists only until the run has an outcome."""
        return self.folder / f"{self.run}.journal"


class Log:
    """Appends records to a file, flushed line by line, so that an interrupted run leaves all it had.

    `records` are those the file already has; a last line that was cut off is removed from it.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.records: list[Record] = list(read(path)) if path.exists() else []
        self._file: BinaryIO = path.open("ab")
        self._file.truncate(path.read_bytes().rfind(b"\n") + 1)

    def __call__(self, record: Record) -> None:
        self._file.write(json.dumps(asdict(record)).encode() + b"\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def read(path: Path) -> Iterator[Record]:
    """Yield the records of a log; a last line that was cut off is left out."""
    with path.open() as lines:
        for line in lines:
            if line.endswith("\n"):
                yield Record(**json.loads(line))


def write_outcome(outcome: Outcome, files: Files) -> None:
    """Write an outcome, all of it or nothing; the journal of the run is not needed any more."""
    write(files.outcome, json.dumps(asdict(outcome), indent=1))
    files.journal.unlink(missing_ok=True)


def read_outcome(path: Path) -> Outcome:
    return Outcome(**json.loads(path.read_text()))


def write(path: Path, text: str) -> None:
    """Replace a file at once, so that no moment has half of it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    part.write_text(text)
    os.replace(part, path)
