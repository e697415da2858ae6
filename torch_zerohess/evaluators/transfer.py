"""Tensors between processes: in one message of a pipe, or in memory that both processes map.

The memory is a file without a name: nothing is left of it when the processes have ended, however they end.
"""

import ctypes
import mmap
import os
import pickle
import tempfile
from collections.abc import Sequence
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any, NamedTuple

import torch
from torch import Tensor

PIPE = 1 << 15
"""Bytes of tensors that go through the pipe; more go through shared memory. A pipe takes as many without a reader."""
_DTYPES = {str(one): one for one in vars(torch).values() if isinstance(one, torch.dtype)}
"""By name: a name is pickled faster than a type."""


class Part(NamedTuple):
    """A tensor as bytes, with its type and shape."""

    dtype: str
    shape: tuple[int, ...]
    data: Any
    """The bytes, or a view of them."""

    @classmethod
    def of(cls, one: Tensor) -> "Part":
        """Return the part of a tensor, with a copy of its bytes, or with a view if they are more than `PIPE`."""
        one = one.detach().cpu().resolve_conj().resolve_neg().contiguous()
        if one.nbytes <= PIPE:
            return cls(str(one.dtype), tuple(one.shape), ctypes.string_at(one.data_ptr(), one.nbytes))
        array: Any = (ctypes.c_char * one.nbytes).from_address(one.data_ptr())
        array.tensor = one  # lives as long as a view of its bytes
        return cls(str(one.dtype), tuple(one.shape), memoryview(array))

    def rows(self, start: int, stop: int) -> "Part":
        """Return `[start:stop]` of it."""
        count, *each = self.shape
        size = len(self.data) // max(1, count)
        return Part(self.dtype, (min(stop, count) - min(start, count), *each), self.data[start * size : stop * size])

    def tensor(self) -> Tensor:
        """Return a tensor with a copy of the bytes."""
        if not len(self.data):
            return torch.empty(self.shape, dtype=_DTYPES[self.dtype], device="cpu")
        return torch.frombuffer(bytearray(self.data), dtype=_DTYPES[self.dtype]).view(self.shape)


def joined(parts: Sequence[Part]) -> Tensor:
    """Return parts of shape [k, *out], of one *out, as one tensor [K, *out], of the wider type if they have two."""
    first = parts[0]
    if any((one.dtype, one.shape[1:]) != (first.dtype, first.shape[1:]) for one in parts):
        return torch.cat([one.tensor() for one in parts])
    count = sum(one.shape[0] for one in parts)
    return Part(first.dtype, (count, *first.shape[1:]), b"".join(one.data for one in parts)).tensor()


def size(parts: Sequence[Part]) -> int:
    """Return how many bytes tensors take."""
    return sum(len(one.data) for one in parts)


def sent(parts: Sequence[Part], memory: "SharedMemory | None" = None) -> list[tuple[Any, ...]]:
    """Return parts as tuples to pickle. Shared memory, if there is one, gets their bytes, one after the other."""
    if memory is None:
        return [(dtype, shape, bytes(data)) for dtype, shape, data in parts]
    start = 0
    for one in parts:
        memory.data[start : start + len(one.data)] = one.data
        start += len(one.data)
    return [(dtype, shape, len(data)) for dtype, shape, data in parts]


def received(found: Sequence[tuple[Any, ...]], memory: "SharedMemory | None" = None) -> list[Part]:
    """Return the parts that `sent` got."""
    if memory is None:
        return [Part(*one) for one in found]
    start, parts = 0, []
    for dtype, shape, count in found:
        parts.append(Part(dtype, shape, memory.data[start : start + count]))
        start += count
    return parts


def packed(tensors: Sequence[Tensor]) -> bytes:
    """Return tensors as bytes, for carriers that know only objects that can be pickled."""
    return pickle.dumps(sent([Part.of(one) for one in tensors]))


def unpacked(message: bytes) -> list[Part]:
    """Return the tensors that `packed` got."""
    return received(pickle.loads(message))


def can_share() -> bool:
    """Whether memory can be handed to another process: not on Windows."""
    return bool(getattr(reduction, "HAVE_SEND_HANDLE", False)) and os.name == "posix"


class SharedMemory:
    """A piece of memory that two processes map."""

    def __init__(self, size: int, file: int | None = None) -> None:
        if file is None:
            file = _nameless()
            os.ftruncate(file, size)
        self.file, self.size = file, size
        self.data = mmap.mmap(file, size)

    def send(self, connection: "Connection[Any, Any]", pid: int) -> None:
        """Let the process at the other end of a pipe map it."""
        reduction.send_handle(connection, self.file, pid)

    @classmethod
    def receive(cls, connection: "Connection[Any, Any]", size: int) -> "SharedMemory":
        """Map what `send` sent."""
        return cls(size, reduction.recv_handle(connection))

    def close(self) -> None:
        self.data.close()
        os.close(self.file)


def _nameless() -> int:
    if hasattr(os, "memfd_create"):
        return os.memfd_create("torch_zerohess")
    with tempfile.TemporaryFile() as file:
        return os.dup(file.fileno())
