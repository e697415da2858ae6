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
    """Time since the start of the run, see `Recorder`; measuring errors and writing files are not counted."""
    evaluations: int
    """Black-box evaluations since the start of the run."""
    sigma: float | None
    loss: float | None
    image_error: float | None
    parameter_error: float | None


@dataclass(frozen=True)
class Preparation:
    """Progress of what comes before a run: so many of the images of its task are rendered."""

    task: str
    method: str
    run: int
    done: int
    total: int


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
    """What the method reported last; empty for a network, see `Files.weights`."""
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
    def weights(self) -> Path:
        """Of a network that was trained."""
        return self.folder / f"{self.run}.pt"

    @property
    def journal(self) -> Path:
        """Exists only until the run has an outcome."""
        return self.folder / f"{self.run}.journal"


class Log:
    """Appends records to a file, flushed line by line, so that a killed run leaves all it had.

    The system writes lines to the disk within a minute, and all of them when the log is closed. So a power cut takes
    the last rows of a run that goes on, which are made again, and no row of a run that has an outcome.

    `records` are those that the file has. Opening it cuts the file off before the first line that is broken.
    """

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.records: list[Record] = []
        self._file: BinaryIO = path.open("a+b")
        self._file.seek(0)
        whole = 0
        for line in self._file:
            record = _record(line)
            if record is None:
                break
            self.records.append(record)
            whole += len(line)
        self._file.truncate(whole)

    def __call__(self, record: Record) -> None:
        self._file.write(json.dumps(asdict(record)).encode() + b"\n")
        self._file.flush()

    def close(self) -> None:
        os.fsync(self._file.fileno())
        self._file.close()


def read(path: Path) -> Iterator[Record]:
    """Yield the records of a log without a last line that was cut off; SystemExit names another that is broken."""
    with path.open("rb") as lines:
        for number, line in enumerate(lines, 1):
            record = _record(line)
            if record is not None:
                yield record
            elif line.endswith(b"\n"):
                raise SystemExit(
                    f"line {number} of {path} is not a row of a run; delete the file and {path.stem}.json beside it, "
                    "then the same `run` command makes the run again"
                )


def _record(line: bytes) -> Record | None:
    """Return the record of a line; None if it is cut or broken."""
    try:
        return Record(**json.loads(line)) if line.endswith(b"\n") else None
    except (ValueError, TypeError):
        return None


def write_outcome(outcome: Outcome, files: Files) -> None:
    """Write an outcome, all of it or nothing; the journal of the run is not needed any more."""
    write(files.outcome, json.dumps(asdict(outcome), indent=1))
    files.journal.unlink(missing_ok=True)


def read_outcome(path: Path) -> Outcome:
    """Return an outcome; SystemExit names a file that has none, or only a part of one."""
    try:
        return Outcome(**json.loads(path.read_text()))
    except (ValueError, TypeError) as error:
        raise SystemExit(
            f"{path} is not the outcome of a run ({error}); delete it, then the same `run` command makes it again"
        ) from error


def write(path: Path, content: str | bytes) -> None:
    """Replace a file at once, so that no moment has half of it, nor the disk after a power cut."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    with part.open("wb") as file:
        file.write(content.encode() if isinstance(content, str) else content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(part, path)
