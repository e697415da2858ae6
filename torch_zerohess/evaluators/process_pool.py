"""Evaluation in processes of this machine, which may crash, hang, or take too much memory.

Why not loky, or another `concurrent.futures` pool, as the carrier: their unit of failure is the whole pool. When one
worker of loky ends, all futures of its executor fail, and which point was at fault is not known; a task has no time
limit and no memory limit of its own, and a task that runs cannot be stopped. Here each worker has its own pipe, so its
end concerns its own chunk alone.
"""

import atexit
import contextlib
import multiprocessing
import multiprocessing.util  # its own end of processes is registered first, hence runs after ours
import os
import sys
import time
import weakref
from collections.abc import Callable, Sequence
from multiprocessing.connection import Connection
from typing import Any

from torch import Tensor

from torch_zerohess.arguments import checked_integer, checked_number
from torch_zerohess.evaluators.ahead import Ahead
from torch_zerohess.evaluators.batch import Batch
from torch_zerohess.evaluators.job import Job
from torch_zerohess.evaluators.kept import MOST
from torch_zerohess.evaluators.payload import dumped, loaded_error
from torch_zerohess.evaluators.worker import ERROR, VALUES
from torch_zerohess.evaluators.worker_errors import unmade, unstarted
from torch_zerohess.evaluators.worker_process import Process, ready

_STARTS = 25
"""Workers in a row that may end before they have a black box: they are killed from outside."""
_MAKES = 5
"""Workers in a row that may end without a value after they got the black box."""
_LOOK = 0.05
"""Seconds between two looks at the memory of workers."""
_ALIVE = 1.0
"""Seconds after which a wait looks again."""
_GRACE = 2.0
"""Seconds that a worker has to end by itself."""


class ProcessPool(Ahead):
    """Calls the black box in worker processes, a few points at a time.

    Workers are new Python processes (spawn) with one thread each, so that a black box with its own threads does not
    take more cores than there are. They start with the first call, and stay. The black box is sent to a worker once;
    what it holds stays there. A worker keeps the four black boxes that were used last, and this process keeps their
    pickled forms. With a `memory_limit` a worker keeps one. Pass `Factory(make, *args)` for a black box that cannot be
    pickled, or that takes long to make. What the caller changes in a black box afterwards does not reach the workers.
    A black box may have processes of its own, such as those of a DataLoader. They end with the worker on Linux and
    macOS.

    A script that makes a pool has its main part under `if __name__ == "__main__":`, because workers import the script.

    A worker that ends, takes too long or takes too much memory is replaced, and its points are tried again, see
    `evaluators.batch`. Points that failed too often have the value NaN: `on_nonfinite` of `BlackBox` and `estimate`
    says what becomes of them, "raise" names the point and how the worker ended. A black box whose first 10 evaluations
    (`retries` + 1 if that is more) end so is given up: `LostEvaluationError`. An exception of the black box is raised
    here, with the worker's traceback as its cause, and not tried again. One that cannot be made again from its pickled
    form is a RuntimeError with its type and text.

    Values have the same bits as with `Inline` for every number of workers, if the black box is deterministic and
    its value of a point does not depend on which points share its call. (Matrix products, and some functions of torch
    such as `sigmoid`, may round differently in the last bit when a call has fewer points. The number of workers makes
    no difference to them either.) fn gets tensors on the CPU. The default type of torch is the caller's.

    Noise differs between workers. A generator that fn holds gets a seed of the worker after the first call that draws
    from it, and this call is made again, see `evaluators.random_numbers`. `timeout` is for each of the two calls.

    The pool ends when it is closed, with the interpreter, and on Linux at once when the interpreter is killed.

    Args:
        workers: number of processes; as many as there are cores for this process if None.
        timeout: seconds that an evaluation of one point may take, the making of the black box not counted.
        retries: further tries of a point whose worker ended.
        recycle: evaluations after which a worker is replaced, for black boxes that leak.
        memory_limit: resident bytes that a worker may take, with the 3e8 to 6e8 of Python and torch. Linux only.

    Raises:
        ValueError: an argument is out of range.
        TypeError: the black box cannot be pickled; the message names the object in it.
        RuntimeError: workers end before they evaluate anything, or this process may have none: it is itself a daemon.

    Example:
        >>> import operator, torch
        >>> with ProcessPool(workers=1) as pool:
        ...     pool(operator.methodcaller("sum", 1), torch.ones(2, 3))
        tensor([3., 3.])
    """

    def __init__(
        self,
        workers: int | None = None,
        *,
        timeout: float | None = None,
        retries: int = 2,
        recycle: int | None = None,
        memory_limit: int | None = None,
    ) -> None:
        self.workers = cores() if workers is None else checked_integer("workers", workers, 1)
        retries = checked_integer("retries", retries, 0)
        recycle = None if recycle is None else checked_integer("recycle", recycle, 1)
        memory_limit = None if memory_limit is None else int(checked_number("memory_limit", memory_limit, above=0.0))
        if memory_limit is not None and sys.platform != "linux":
            raise ValueError(f"memory_limit needs Linux, which says how much memory a process has, got {sys.platform}")
        self.timeout = None if timeout is None else checked_number("timeout", timeout, above=0.0)
        self.retries, self.recycle, self.memory_limit = retries, recycle, memory_limit
        self._most = MOST if memory_limit is None else 1  # a limit is for one
        super().__init__()
        self._forget()
        _pools.add(self)

    def __repr__(self) -> str:
        settings = f"workers={self.workers}, timeout={self.timeout}, retries={self.retries}"
        return f"ProcessPool({settings}, recycle={self.recycle}, memory_limit={self.memory_limit})"

    def __reduce__(self) -> tuple[Any, ...]:
        settings = {"timeout": self.timeout, "retries": self.retries}
        settings |= {"recycle": self.recycle, "memory_limit": self.memory_limit}
        return _again, (self.workers, settings)

    def close(self) -> None:
        """End all workers; one that does not end by itself is killed. Calls that are under way raise RuntimeError."""
        if self._process == os.getpid():
            super().close()
        self._closed = True

    def _end(self) -> None:
        every = self._staffed + [one for one, _ in self._leaving]
        for one in self._staffed:
            one.leave()
        until = time.monotonic() + _GRACE
        for one in every:
            one.end(0.0 if one.chunk is not None or one.number is None else max(0.0, until - time.monotonic()))
        self._staffed.clear()
        self._leaving.clear()
        for end in self._bell:
            end.close()

    def _forget(self) -> None:
        self._process = os.getpid()
        self._staffed: list[Process] = []
        self._leaving: list[tuple[Process, float]] = []
        self._failed_starts = 0
        self._bell: tuple[Connection[Any, Any], Connection[Any, Any]] = multiprocessing.Pipe(duplex=False)
        """A pipe whose messages end a wait."""
        self._rung = False

    def _check_open(self) -> None:
        super()._check_open()
        if self._process != os.getpid():  # after a fork, workers, pipes and threads belong to the other process
            self._alone()
            self._forget()

    def _sent(self, fn: Callable[..., Any]) -> bytes:
        return dumped(fn)

    def _batch(self, points: Tensor) -> Batch:
        return Batch(points, self.retries)

    def _round(self, jobs: Sequence[Job]) -> None:
        self._staff(jobs)
        self._assign(jobs)
        self._listen(jobs)

    def _give_up(self, jobs: Sequence[Job]) -> None:
        for one in [one for one in self._staffed if one.job in jobs]:
            self._remove(one)

    def _wake(self) -> None:
        if not self._rung:
            self._rung = True
            with contextlib.suppress(OSError):  # closed meanwhile
                self._bell[1].send_bytes(b"")

    def _staff(self, jobs: Sequence[Job]) -> None:
        """Replace workers that are due, and start new ones: one per chunk, at most `workers`."""
        for one in [one for one in self._staffed if one.ready and self.recycle and one.evaluations >= self.recycle]:
            self._staffed.remove(one)
            one.leave()
            self._leaving.append((one, time.monotonic() + _GRACE))
        for pair in [pair for pair in self._leaving if not pair[0].process.is_alive() or time.monotonic() > pair[1]]:
            self._leaving.remove(pair)
            pair[0].end()
        chunks = sum(len(job.batch.waiting) + len(job.batch.busy) for job in jobs if not job.over)
        wanted = min(self.workers, chunks)
        while len(self._staffed) < wanted:
            self._staffed.append(Process())

    def _assign(self, jobs: Sequence[Job]) -> None:
        for one in self._staffed:
            job = next((job for job in jobs if job.waiting), None) if one.ready else None
            if job is None:
                continue
            try:
                if job.function.number not in one.kept:
                    one.give_function(job.function.number, job.function.sent, self._most)
                elif job.begin():
                    one.give(job, job.batch.take(), self.timeout)
            except (BrokenPipeError, ConnectionResetError):
                pass  # its end is seen by who listens

    def _listen(self, jobs: Sequence[Job]) -> None:
        """Wait until something happens, and treat it."""
        seconds = _ALIVE if self.memory_limit is None else _LOOK
        for one in self._staffed:
            if one.deadline is not None:
                seconds = min(seconds, max(0.0, one.deadline - time.monotonic()))
        handles = [handle for one in self._staffed for handle in one.handles]
        found = ready([*handles, self._bell[0]], seconds)
        if self._bell[0] in found:
            self._rung = False
            self._bell[0].recv_bytes()
        for one in list(self._staffed):
            if one.connection in found:
                self._hear(one, jobs)
            elif one.process.sentinel in found or (not found and not one.process.is_alive()):
                self._lose(one, jobs, None)
            elif one.deadline is not None and time.monotonic() > one.deadline:
                self._lose(one, jobs, f"the black box took longer than timeout={self.timeout:g} s per point")
            elif too_large := self._too_large(one):
                self._lose(one, jobs, too_large)

    def _hear(self, one: Process, jobs: Sequence[Job]) -> None:
        job, chunk = one.job, one.chunk
        try:
            kind, header, parts = one.receive()
        except (EOFError, OSError):
            self._lose(one, jobs, None)
            return
        if too_large := self._too_large(one):
            one.job, one.chunk = job, chunk
            self._lose(one, jobs, too_large)
        elif kind == ERROR:
            making, data = header
            error = loaded_error(data)
            if making:  # calls with other black boxes go on
                number = one.forget()
                for each in [each for each in jobs if each.function.number == number]:
                    each.error = unmade(error)
                return
            assert job is not None
            assert chunk is not None
            job.batch.raised(chunk, error)
        elif kind == VALUES:
            assert job is not None
            assert chunk is not None
            self._failed_starts = 0
            job.batch.came(chunk, parts[0])

    def _too_large(self, one: Process) -> str:
        """Return that a worker takes too much memory, or nothing."""
        if self.memory_limit is None or (used := one.bytes_used()) <= self.memory_limit:
            return ""
        return f"the process of the black box took {used:.4g} bytes, more than memory_limit={self.memory_limit:.4g}"

    def _lose(self, one: Process, jobs: Sequence[Job], reason: str | None) -> None:
        """Remove a worker that ended, or that must; its chunk has failed."""
        job, chunk, number = one.job, one.chunk, one.number
        how = self._remove(one, _GRACE if reason is None else 0.0)  # it ends, so let it say how
        if job is not None and chunk is not None:
            job.batch.failed(chunk, reason or f"the black box ended its process ({how})")
            return
        self._failed_starts += 1
        error = None
        if number is None and how.startswith("exit code"):
            error = unstarted(how)
        elif self._failed_starts > (_STARTS if number is None else _MAKES) or reason is not None:
            when = "at its start" if number is None else "while it made the black box"
            error = RuntimeError(
                f"a worker process ended {when}: {reason or how}, {self._failed_starts} times in a row without a value"
            )
        for each in jobs if error else ():  # calls with other black boxes go on
            if number is None or each.function.number == number:
                each.error = error

    def _remove(self, one: Process, grace: float = 0.0) -> str:
        self._staffed.remove(one)
        return one.end(grace)


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _again(workers: int, settings: dict[str, Any]) -> ProcessPool:
    return ProcessPool(workers, **settings)


_pools: "weakref.WeakSet[ProcessPool]" = weakref.WeakSet()


@atexit.register
def _close_all() -> None:
    for pool in list(_pools):
        pool.close()
