"""The log of a run: one JSON line per iteration."""

import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path


@dataclass(frozen=True)
class Record:
    """State of a run after an iteration. Errors are mean squares; `None` where a row does not have one."""

    task: str
    method: str
    run: int
    iteration: int
    seconds: float
    """Wall-clock time since the start of the run; measuring errors is not counted."""
    evaluations: int
    """Black-box evaluations since the start of the run."""
    sigma: float | None
    loss: float | None
    image_error: float | None
    parameter_error: float | None


class Log:
    """Appends records to a file, flushed line by line, so that an interrupted run leaves all it had."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("w")

    def __call__(self, record: Record) -> None:
        self._file.write(json.dumps(asdict(record)) + "\n")
        self._file.flush()

    def close(self) -> None:
        self._file.close()


def read(path: Path) -> Iterator[Record]:
    """Yield the records of a log; a last line that was cut off is left out."""
    with path.open() as lines:
        for line in lines:
            if line.endswith("\n"):
                yield Record(**json.loads(line))
