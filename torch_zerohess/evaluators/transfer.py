"""Tensors between processes: in one message of a pipe, or in memory that both processes map.

The memory is a file without a name: nothing is left of it when the processes have ended, however they end.
"""

import mmap
import os
import pickle
import struct
import tempfile
from collections.abc import Sequence
from multiprocessing import reduction
from multiprocessing.connection import Connection
from typing import Any

import torch
from torch import Tensor

PIPE = 1 << 15
"""Bytes of tensors that go through the pipe; more go through shared memory. A pipe takes as many without a reader."""
_ALIGNED = 64
_LENGTH = struct.Struct("<Q")

Spec = tuple[torch.dtype, tuple[int, ...], int, int]
"""Type, shape, first byte and number of bytes of a tensor."""


def specs(tensors: Sequence[Tensor]) -> tuple[list[Spec], int]:
    """Return where tensors lie one after the other, and how many bytes they take."""
    found, offset = [], 0
    for one in tensors:
        size = one.numel() * one.element_size()
        found.append((one.dtype, tuple(one.shape), offset, size))
        offset += -(-size // _ALIGNED) * _ALIGNED
    return found, offset


def write(tensors: Sequence[Tensor], where: Sequence[Spec], target: Any, start: int = 0) -> None:
    """Copy tensors into a writable buffer."""
    for one, (dtype, shape, offset, size) in zip(tensors, where, strict=True):
        if size:
            place = torch.frombuffer(target, dtype=dtype, count=one.numel(), offset=start + offset)
            place.reshape(shape).copy_(one.detach())


def read(where: Sequence[Spec], source: Any, start: int = 0) -> list[Tensor]:
    """Return copies of the tensors in a writable buffer."""
    result = []
    for dtype, shape, offset, size in where:
        one = torch.empty(shape, dtype=dtype, device="cpu")
        if size:
            place = torch.frombuffer(source, dtype=dtype, count=one.numel(), offset=start + offset)
            one.reshape(-1).copy_(place)
        result.append(one)
    return result


def packed(tensors: Sequence[Tensor]) -> bytes:
    """Return tensors as bytes, for carriers that know only objects that can be pickled."""
    where, size = specs(tensors)
    header = pickle.dumps(where)
    message = bytearray(_LENGTH.size + len(header) + size)
    message[: _LENGTH.size] = _LENGTH.pack(len(header))
    message[_LENGTH.size : _LENGTH.size + len(header)] = header
    write(tensors, where, message, _LENGTH.size + len(header))
    return bytes(message)


def unpacked(message: bytes) -> list[Tensor]:
    """Return the tensors of `packed`."""
    data = bytearray(message)
    (length,) = _LENGTH.unpack_from(data)
    return read(pickle.loads(data[_LENGTH.size : _LENGTH.size + length]), data, _LENGTH.size + length)


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
