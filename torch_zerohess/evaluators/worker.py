"""What runs in a worker process: it gets a black box once, then points, until its pipe is closed."""

import contextlib
import multiprocessing
import pickle
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.evaluators import transfer
from torch_zerohess.evaluators.default_dtype import take_default_dtype
from torch_zerohess.evaluators.factory import Each
from torch_zerohess.evaluators.lifetime import end_with_parent
from torch_zerohess.evaluators.payload import dumped_error
from torch_zerohess.evaluators.process_identity import become_worker, in_this_process
from torch_zerohess.evaluators.random_numbers import Apart
from torch_zerohess.evaluators.values import checked_values

READY, FUNCTION, EVALUATE, VALUES, ROOM, ERROR, AGAIN = range(7)
"""Kinds of messages: see `Messages`."""


class Messages:
    """One end of a pipe, and the memory that both of its ends map.

    A message is a kind, a header and tensors. Tensors beyond `transfer.PIPE` bytes lie in the memory, which belongs to
    the side that sends points. A worker with values that do not fit asks for more of it (ROOM).

    | kind | from | header | tensors |
    |---|---|---|---|
    | READY | worker | None | |
    | FUNCTION | caller, then worker | default type, number, numbers of those that go; None | a black box; none |
    | EVALUATE | caller | default type, number of a black box | points, aux |
    | VALUES | worker | None | values |
    | ROOM | worker, then caller | bytes | |
    | ERROR | worker | whether fn could not be made, and the error | |
    | AGAIN | worker | None: it evaluates the points once more, see `Apart` | |
    """

    def __init__(self, connection: "Connection[Any, Any]") -> None:
        self.connection = connection
        self.memory: transfer.SharedMemory | None = None

    def send(self, kind: int, header: Any = None, parts: Sequence[transfer.Part] = (), *, shared: bool = False) -> None:
        """Send a message; `shared` puts its tensors into the memory."""
        found = transfer.sent(parts, self.memory if shared else None)
        self.connection.send_bytes(pickle.dumps((kind, header, found, shared)))

    def receive(self) -> tuple[int, Any, list[transfer.Part]]:
        """Return kind, header and tensors of the next message; EOFError or OSError if there is none."""
        kind, header, found, shared = pickle.loads(self.connection.recv_bytes())
        return kind, header, transfer.received(found, self.memory if shared else None)

    def fits(self, size: int) -> bool:
        """Whether so many bytes fit into the memory."""
        return self.memory is not None and size <= self.memory.size

    def close(self) -> None:
        self.connection.close()
        if self.memory is not None:
            self.memory.close()
            self.memory = None


class Kept:
    """A black box of this process."""

    def __init__(self, fn: Any, again: Callable[[], None]) -> None:
        self.fn, self.again = fn, again
        self.apart: Apart = in_this_process(Apart, fn)

    def values(self, parts: Sequence[transfer.Part]) -> Tensor:
        """Return the values of points and auxiliary inputs."""
        return self.apart.call(lambda: self._values(parts), self.again)

    def _values(self, parts: Sequence[transfer.Part]) -> Tensor:
        tensors = [one.tensor() for one in parts]
        return checked_values(in_this_process(self.fn, *tensors), tensors[0], not isinstance(self.fn, Each))


def main(connection: "Connection[Any, Any]") -> None:
    """Serve until the pipe is closed."""
    end_with_parent()
    become_worker()
    multiprocessing.current_process().daemon = False  # the black box may have processes: they end with the group
    _leave_no_core()
    torch.set_num_threads(1)
    messages = Messages(connection)
    kept: dict[int, Kept] = {}
    """By number; the caller says which ones stay."""
    with contextlib.suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the pool was closed
        messages.send(READY)
        while True:
            kind, header, parts = messages.receive()
            if kind == ROOM:
                _map(messages, header)
                continue
            values = None
            torch.set_grad_enabled(kind == FUNCTION)  # it is made with gradients, and called without
            try:
                dtype, number, *gone = header
                take_default_dtype(dtype)
                if kind == FUNCTION:
                    for one in gone:  # what they hold is given back before the next one is made
                        del kept[one]
                    kept[number] = Kept(pickle.loads(parts[0].data), lambda: messages.send(AGAIN))
                else:
                    values = kept[number].values(parts)
            except BaseException as error:  # SystemExit too: it is the black box's, not this process's
                messages.send(ERROR, (kind == FUNCTION, dumped_error(error, traceback.format_exc())))
            else:
                _answer(messages, values)


def _answer(messages: Messages, values: Tensor | None) -> None:
    if values is None:
        messages.send(FUNCTION)
        return
    parts = [transfer.Part.of(values)]
    size = transfer.size(parts)
    shared = size > transfer.PIPE and transfer.can_share()
    if shared and not messages.fits(size):
        messages.send(ROOM, size)
        _, room, _ = messages.receive()
        _map(messages, room)
    messages.send(VALUES, parts=parts, shared=shared)


def _map(messages: Messages, size: int) -> None:
    if messages.memory is not None:
        messages.memory.close()
    messages.memory = transfer.SharedMemory.receive(messages.connection, size)


def _leave_no_core() -> None:
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
