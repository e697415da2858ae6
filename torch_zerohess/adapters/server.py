"""A program that goes on running and answers requests, and what errors say of a program."""

import contextlib
import io
import math
import os
import subprocess
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import IO, Any

from torch_zerohess.evaluators.lifetime import end_group, end_tree, ending, ends_by_its_group

GRACE = 1.0
"""Seconds that a program has to end, and that pipes have to close after it."""

_WAIT = 1.0
"""Seconds after which Ctrl-C is looked for, at most."""

_KEPT = 50
"""Lines of the standard error that are shown in an error."""


class Server:
    """A program that runs, and threads that read what it writes."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self.process = process
        self._owner = os.getpid()
        self.errors: deque[bytes] = deque(maxlen=_KEPT)
        self._exchange: threading.Thread | None = None
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def ask(self, request: bytes, npy: bool, limit: float | None) -> bytes:
        """Return the answer to a request. ValueError if the program wrote something since the last one."""
        command: Any = self.process.args
        self.refuse_more("before the next request")
        answer: list[bytes] = []

        def exchange() -> None:
            assert self.process.stdin is not None
            assert self.process.stdout is not None
            with contextlib.suppress(OSError, ValueError):
                self.process.stdin.write(request)
                self.process.stdin.flush()
                answer.append(_read_npy(self.process.stdout) if npy else self.process.stdout.readline())

        self._exchange = thread = threading.Thread(target=exchange, daemon=True)
        try:
            thread.start()
            _join(thread, limit)
        except BaseException:  # Ctrl-C, which a group of its own does not get
            end_program(self.process)
            raise
        if thread.is_alive():
            end_program(self.process)
            thread.join(GRACE)
            self._listener.join(GRACE)
            raise TimeoutError(late(command, limit, b"".join(self.errors)))
        if not answer or not answer[0]:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(2.0)
            end_program(self.process)
            self._listener.join(GRACE)
            raise RuntimeError(ended(command, self.process.wait(), b"".join(self.errors)))
        return answer[0]

    def refuse_more(self, when: str) -> None:
        """Raise ValueError if the program wrote something that nobody asked for."""
        command: Any = self.process.args
        if more := _pending(self.process.stdout):
            raise ValueError(
                f"the program {command[0]!r} wrote more than one answer to a request, or other text beside it: "
                f"{more[:200].decode(errors='replace')!r} was there {when}; let it write one answer and flush, and "
                f"print messages to its standard error{shown(b''.join(self.errors))}"
            )

    def end(self) -> None:
        """Close the input of the program, and kill it if it does not end. The programs that it started end with it.

        After a fork it belongs to the process that started it, and this does nothing in the other one.
        """
        if self._owner != os.getpid():
            return
        self._close(self.process.stdin, self._exchange)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(GRACE)
        end_program(self.process)
        self.process.wait()
        self._close(self.process.stdin, self._exchange)  # if a request was on its way before
        self._close(self.process.stdout, self._exchange)
        self._close(self.process.stderr, self._listener)

    def _close(self, pipe: IO[bytes] | None, user: threading.Thread | None) -> None:
        """Close a pipe, unless a thread still uses it: that would wait for a program that left the group."""
        assert pipe is not None
        if user is not None and user.ident is not None:  # Ctrl-C may have come before it began
            user.join(GRACE)
        if user is None or not user.is_alive():
            with contextlib.suppress(OSError):
                pipe.close()

    def _listen(self) -> None:
        assert self.process.stderr is not None
        with contextlib.suppress(OSError, ValueError):
            self.errors.extend(self.process.stderr)


def _join(thread: threading.Thread, limit: float | None) -> None:
    """Wait for a thread. A Ctrl-C that comes just before a wait is noticed after it, so that each wait is short."""
    end = math.inf if limit is None else time.monotonic() + limit
    while thread.is_alive() and (left := end - time.monotonic()) > 0.0:
        thread.join(min(left, _WAIT))


def end_program(process: "subprocess.Popen[bytes]") -> None:
    """Kill a program and the programs that it started."""
    if not ends_by_its_group():
        end_group(process.pid)
    elif process.poll() is None:
        end_tree(process.pid)
    process.kill()


def _pending(file: Any) -> bytes:
    """Return what can be read from a pipe at once, and leave it there."""
    if not hasattr(os, "set_blocking"):
        return b""
    os.set_blocking(file.fileno(), False)
    try:
        return bytes(file.peek(1))
    finally:
        os.set_blocking(file.fileno(), True)


def _read_npy(file: IO[bytes]) -> bytes:
    """Return the bytes of one array. If the program wrote something else, return one line of it."""
    start = file.read(6)
    if start != b"\x93NUMPY":
        return start + (b"" if b"\n" in start else file.readline())
    import numpy as np

    version = file.read(2)
    first = version[:1] == b"\x01"
    size = file.read(2 if first else 4)  # nothing where the program ended: ValueError below
    header = file.read(int.from_bytes(size, "little"))
    layout = io.BytesIO(size + header)
    read = np.lib.format.read_array_header_1_0 if first else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(layout)
    return start + version + size + header + file.read(int(np.prod(shape)) * dtype.itemsize)


def late(command: Sequence[str], limit: float | None, errors: bytes) -> str:
    """Return the message for a program that was stopped, with its standard error."""
    return f"the program {command[0]!r} gave no answer within timeout: {limit:g} s{shown(errors)}"


def ended(command: Sequence[str], code: int, errors: bytes) -> str:
    """Return the message for a program that ended by itself, with its standard error."""
    how = f"was killed by signal {-code} ({ending(code)})" if code < 0 else f"ended with code {code}"
    return f"the program {command[0]!r} {how} and without an answer{shown(errors)}"


def shown(errors: bytes) -> str:
    """Return the end of what a program wrote to its standard error, to append to a message."""
    lines = errors.decode(errors="replace").strip().splitlines()[-_KEPT:]
    return "; it wrote to its standard error:\n" + "\n".join(lines) if lines else ""
