"""A program that goes on running and answers requests, and what errors say of a program."""

import contextlib
import io
import subprocess
import threading
from collections import deque
from collections.abc import Sequence
from typing import IO, Any

_KEPT = 50
"""Lines of the standard error that are shown in an error."""


class Server:
    """A program that runs, and threads that read what it writes."""

    def __init__(self, process: "subprocess.Popen[bytes]") -> None:
        self.process = process
        self.errors: deque[bytes] = deque(maxlen=_KEPT)
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()

    @property
    def alive(self) -> bool:
        return self.process.poll() is None

    def ask(self, request: bytes, npy: bool, limit: float | None) -> bytes:
        """Return the answer to a request."""
        answer: list[bytes] = []

        def exchange() -> None:
            assert self.process.stdin is not None
            assert self.process.stdout is not None
            with contextlib.suppress(OSError, ValueError):
                self.process.stdin.write(request)
                self.process.stdin.flush()
                answer.append(_read_npy(self.process.stdout) if npy else self.process.stdout.readline())

        thread = threading.Thread(target=exchange, daemon=True)
        thread.start()
        thread.join(limit)
        command: Any = self.process.args
        if thread.is_alive():
            self.process.kill()
            thread.join()
            self._listener.join(1.0)
            raise TimeoutError(late(command, limit, b"".join(self.errors)))
        if not answer or not answer[0]:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self.process.wait(2.0)
            self.process.kill()
            self._listener.join(1.0)
            raise RuntimeError(ended(command, self.process.wait(), b"".join(self.errors)))
        return answer[0]

    def end(self) -> None:
        """Close the input of the program, and kill it if it does not end."""
        assert self.process.stdin is not None
        with contextlib.suppress(OSError):
            self.process.stdin.close()
        try:
            self.process.wait(1.0)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
        self._listener.join(1.0)
        for pipe in (self.process.stdout, self.process.stderr):
            assert pipe is not None
            pipe.close()

    def _listen(self) -> None:
        assert self.process.stderr is not None
        with contextlib.suppress(OSError, ValueError):
            self.errors.extend(self.process.stderr)


def _read_npy(file: IO[bytes]) -> bytes:
    """Return the bytes of one array. If the program wrote something else, return one line of it."""
    start = file.read(6)
    if start != b"\x93NUMPY":
        return start + (b"" if b"\n" in start else file.readline())
    import numpy as np

    version = file.read(2)
    size = file.read(2 if version[0] == 1 else 4)
    header = file.read(int.from_bytes(size, "little"))
    layout = io.BytesIO(size + header)
    read = np.lib.format.read_array_header_1_0 if version[0] == 1 else np.lib.format.read_array_header_2_0
    shape, _, dtype = read(layout)
    return start + version + size + header + file.read(int(np.prod(shape)) * dtype.itemsize)


def late(command: Sequence[str], limit: float | None, errors: bytes) -> str:
    """Return the message for a program that was stopped, with its standard error."""
    return f"the program {command[0]!r} gave no answer within timeout: {limit:g} s{shown(errors)}"


def ended(command: Sequence[str], code: int, errors: bytes) -> str:
    """Return the message for a program that ended by itself, with its standard error."""
    return f"the program {command[0]!r} ended with code {code} and without an answer{shown(errors)}"


def shown(errors: bytes) -> str:
    """Return the end of what a program wrote to its standard error, to append to a message."""
    lines = errors.decode(errors="replace").strip().splitlines()[-_KEPT:]
    return "; it wrote to its standard error:\n" + "\n".join(lines) if lines else ""
