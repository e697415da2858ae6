"""The journal of a run: the values of every evaluated batch, so that a run that was killed can be replayed.

A batch is a line of JSON (a hash of the points, times, shape and type of the values) followed by the compressed values.
A kill or a power cut may leave a batch in parts: reading cuts the journal off before the first such batch. The system
writes a batch to the disk within a minute, so a power cut costs the last minute.
"""

import hashlib
import importlib.util
import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch
from torch import Tensor

_FCNTL = importlib.import_module("fcntl") if importlib.util.find_spec("fcntl") else None
"""Locks of files; Windows has none, so that nothing keeps a second process out there."""


class DivergedError(Exception):
    """A replayed run asks for other points than its journal has: the method or its settings have changed."""


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
            if _FCNTL:
                _FCNTL.flock(self._file, _FCNTL.LOCK_EX | _FCNTL.LOCK_NB)
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
        if not _FCNTL:  # without a lock to keep, and where an open file cannot be deleted
            self.close()
        self._path.unlink(missing_ok=True)
        self.close()

    def _read(self) -> Iterator[Entry]:
        whole = 0
        while True:
            self._file.seek(whole)
            entry = self._batch()
            if entry is None:
                self._file.truncate(whole)
                return
            whole = self._file.tell()
            yield entry

    def _batch(self) -> Entry | None:
        """Return the batch at the position of the file; None if it is not whole."""
        line = self._file.readline()
        try:
            head: dict[str, Any] = json.loads(line)
            data = zlib.decompress(self._file.read(head["bytes"]))
            values = torch.from_numpy(np.frombuffer(bytearray(data), head["type"]).reshape(head["shape"]))
            return Entry(head["points"], values, head["seconds"], head["black_box_seconds"])
        except (ValueError, TypeError, KeyError, zlib.error):
            return None


def _digest(points: Tensor) -> str:
    return hashlib.blake2b(points.contiguous().numpy().tobytes(), digest_size=8).hexdigest()
