"""A worker process, as its caller sees it."""

import multiprocessing
import select
import time
from collections.abc import Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from torch_zerohess.evaluators import transfer, worker
from torch_zerohess.evaluators.batch import Chunk
from torch_zerohess.evaluators.default_dtype import default_dtype
from torch_zerohess.evaluators.job import Job
from torch_zerohess.evaluators.kept import make_room, used
from torch_zerohess.evaluators.lifetime import end_group, ending, started_worker
from torch_zerohess.evaluators.worker import AGAIN, EVALUATE, FUNCTION, READY, ROOM, Messages


class Process:
    """A worker: it starts, gets a black box, and then evaluates one chunk at a time."""

    def __init__(self) -> None:
        if multiprocessing.current_process().daemon:
            raise RuntimeError(
                "a ProcessPool cannot start workers in a daemon of multiprocessing, such as a worker of a DataLoader: "
                "leave evaluator=None there, or call the black box in the main process"
            )
        self.process, mine = started_worker(worker.main, "torch_zerohess worker", daemon=True)
        self.messages = Messages(mine)
        self.ready = False
        """Whether it waits for a black box or points."""
        self.number: int | None = None
        """Number of the black box that it got last."""
        self.kept: dict[int, None] = {}
        """Numbers of the black boxes that it has, the one that was used last at the end."""
        self.chunk: Chunk | None = None
        """What it evaluates."""
        self.job: Job | None = None
        """The call that the chunk is of."""
        self.seconds: float | None = None
        """How long the evaluation may take."""
        self.deadline: float | None = None
        self.evaluations = 0

    @property
    def connection(self) -> "Connection[Any, Any]":
        return self.messages.connection

    @property
    def handles(self) -> list[Any]:
        """What becomes ready with a message, or when the process ends."""
        return [self.connection, self.process.sentinel]

    def give_function(self, number: int, payload: bytes, most: int) -> None:
        """Send a black box, in place of others if there would be more than `most`."""
        self.ready, self.number = False, number
        gone = make_room(self.kept, most)
        self.kept[number] = None
        parts = [transfer.Part("torch.uint8", (len(payload),), payload)]
        self.messages.send(FUNCTION, (default_dtype(), number, *gone), parts, shared=self._room(parts))

    def give(self, job: Job, chunk: Chunk, timeout: float | None) -> None:
        """Send the points of a chunk."""
        self.ready, self.job, self.chunk = False, job, chunk
        parts = [one.rows(chunk.start, chunk.stop) for one in job.parts]
        used(self.kept, job.function.number)
        self.messages.send(EVALUATE, (default_dtype(), job.function.number), parts, shared=self._room(parts))
        self.seconds = None if timeout is None else timeout * len(chunk)
        self._begin()

    def _begin(self) -> None:
        self.deadline = None if self.seconds is None else time.monotonic() + self.seconds

    def forget(self) -> int | None:
        """Return the number of the black box that it got last, and could not make."""
        number, self.number = self.number, None
        if number is not None:
            del self.kept[number]
        return number

    def receive(self) -> tuple[int, Any, list[transfer.Part]]:
        """Return the next message; EOFError or OSError if the process has ended."""
        kind, header, parts = self.messages.receive()
        if kind == ROOM:
            self._enlarge(header)
        elif kind == AGAIN:
            self._begin()
        elif kind != READY and self.chunk is not None:
            self.evaluations += len(self.chunk)
            self.chunk = self.job = self.deadline = None
        self.ready = kind not in (ROOM, AGAIN)
        return kind, header, parts

    def _room(self, parts: Sequence[transfer.Part]) -> bool:
        """Make room in the memory for parts; False if they are small enough for the pipe."""
        size = transfer.size(parts)
        if size <= transfer.PIPE or not transfer.can_share():
            return False
        if not self.messages.fits(size):
            self._enlarge(size)
        return True

    def _enlarge(self, size: int) -> None:
        if self.messages.memory is not None:
            self.messages.memory.close()
        self.messages.memory = transfer.SharedMemory(size + size // 4)
        self.messages.send(ROOM, self.messages.memory.size)
        self.messages.memory.send(self.connection, self.process.pid or 0)

    def bytes_used(self) -> int:
        """Most resident bytes so far; 0 for a process that has ended. Linux only."""
        try:
            lines = Path(f"/proc/{self.process.pid}/status").read_text().splitlines()
        except OSError:
            return 0
        return next((1024 * int(line.split()[1]) for line in lines if line.startswith("VmHWM:")), 0)

    def leave(self) -> None:
        """Let it end by itself, as soon as it waits for a message."""
        self.messages.close()

    def end(self, grace: float = 0.0) -> str:
        """End it, with the programs that it started, and return how it ended.

        grace: seconds that it has to end by itself.
        """
        if grace:
            wait([self.process.sentinel], grace)
        if self.process.pid is not None:
            end_group(self.process.pid)
        self.process.kill()
        self.process.join()
        self.messages.close()
        return ending(self.process.exitcode or 0)


def ready(handles: Sequence[Any], seconds: float) -> set[Any]:
    """Return which connections and sentinels are ready, as `multiprocessing.connection.wait`, which is slower."""
    if not hasattr(select, "poll"):  # Windows
        return set(wait(handles, seconds))
    numbers = {one if isinstance(one, int) else one.fileno(): one for one in handles}
    poll = select.poll()
    for number in numbers:
        poll.register(number, select.POLLIN)
    return {numbers[number] for number, _ in poll.poll(1000 * seconds)}
