"""The journal of a run: the values of every evaluated batch, so that a run that was killed can be replayed.

A batch is a line of JSON (a hash of the points, times, shape and type of the values) followed by the compressed values.
What a kill left of a last batch is cut off when the journal is opened again.
"""

import fcntl
import hashlib
import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor


class DivergedError(Exception):
    """A replayed run asks for other points than those of its journal: the method or its settings have changed."""


class BusyError(Exception):
    """The journal is being written by another process."""


@dataclass(frozen=True)
class Entry:
    """One evaluated batch, and both clocks after it."""

    points: str
    values: Tensor
    seconds: float
    black_box_seconds: float


class Journal:
    """Answers with the batches it has, then takes new ones."""

    def __init__(self, path: Path) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        self._file: BinaryIO = path.open("a+b")
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            self._file.close()
            raise BusyError(f"{path} is being written by another process") from error
        self._entries: Iterator[Entry] = self._read()

    def replay(self, points: Tensor) -> Entry | None:
        """Return the next batch if the journal has one; DivergedError if that is a batch of other points."""
        entry = next(self._entries, None)
        if entry is not None and entry.points != _digest(points):
            raise DivergedError(f"{self._path} has values of other points")
        return entry

    def append(self, points: Tensor, values: Tensor, seconds: float, black_box_seconds: float) -> None:
        data = zlib.compress(values.contiguous().numpy().tobytes(), 1)
        head: dict[str, Any] = {
            "points": _digest(points),
            "seconds": seconds,
            "black_box_seconds": black_box_seconds,
            "shape": list(values.shape),
            "type": str(values.dtype).removeprefix("torch."),
            "bytes": len(data),
        }
        self._file.write(json.dumps(head).encode() + b"\n" + data)
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def delete(self) -> None:
        self._path.unlink(missing_ok=True)
        self.close()

    def _read(self) -> Iterator[Entry]:
        self._file.seek(0)
        whole = 0
        while True:
            line = self._file.readline()
            head: dict[str, Any] = json.loads(line) if line.endswith(b"\n") else {"bytes": 1}
            data = self._file.read(head["bytes"])
            if len(data) < head["bytes"]:
                self._file.truncate(whole)
                return
            whole = self._file.tell()
            values = np.frombuffer(bytearray(zlib.decompress(data)), head["type"]).reshape(head["shape"])
            yield Entry(head["points"], torch.from_numpy(values), head["seconds"], head["black_box_seconds"])
            self._file.seek(whole)


def _digest(points: Tensor) -> str:
    return hashlib.blake2b(points.contiguous().numpy().tobytes(), digest_size=8).hexdigest()
