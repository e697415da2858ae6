"""Calls that do not wait for each other: `submit` returns a future, and the points of all calls share the workers.

Calls are served in rounds: give points to workers, wait until one of them has news, take it. A call alone is served by
the thread that made it. The first `submit`, or a call beside another one, starts a thread that serves all calls from
then on; a call that is under way is handed to it between two rounds. Calls are begun in their order, so the values of
an early call come early. A call has the same bits as it would have alone. The thread keeps the evaluator alive only
while there are calls.
"""

import contextlib
import threading
import weakref
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from queue import SimpleQueue
from typing import Any

from torch import Tensor

from torch_zerohess.evaluators.batch import MOST, Batch
from torch_zerohess.evaluators.evaluator import Closing, EvaluationFuture
from torch_zerohess.evaluators.factory import same
from torch_zerohess.evaluators.inline import values_without_points
from torch_zerohess.evaluators.job import Function, Job
from torch_zerohess.evaluators.kept import make_room, used
from torch_zerohess.evaluators.partial_values import keep_finished


class Ahead(Closing, ABC):
    """An evaluator whose calls may overlap. A subclass says how a round goes."""

    @property
    def single_points(self) -> int:
        """Points of a call up to which a chunk has one point."""
        return MOST

    def __init__(self) -> None:
        self._functions: dict[int, Function] = {}
        """Black boxes by number, the one that was used last at the end."""
        self._closed = False
        self._alone()

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Tensor:
        """Return fn(points [K, n], *aux [K, ...]), values [K, *out] on the device of the points."""
        self._check_open()
        if len(points) == 0:
            return values_without_points(fn, points, aux)
        if threading.current_thread() is self._thread:
            raise RuntimeError(f"a callback of a future may submit to the {type(self).__name__}, but not wait for it")
        job = self._job(fn, points, aux)
        job.begin()
        try:
            if self._serving.acquire(blocking=False):
                try:
                    self._serve_alone(job)
                finally:
                    self._serving.release()
            else:  # another thread has a call, too
                self._queue(job)
            self._await(job)
            self._calls.lost = job.batch.lost
            return job.future.result()
        except BaseException as error:  # of the black box, or Ctrl-C
            keep_finished(error, points, job.batch.known)
            raise

    def submit(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> EvaluationFuture:
        """Return a `concurrent.futures.Future` of what a call with these arguments returns.

        Several may be under way: their points share the workers, in the order of the submissions. The `lost` of the
        future has the points without a value. `cancel()` works until the first point is given to a worker. `close()`
        does not wait: a future that is not done then raises RuntimeError.
        """
        self._check_open()
        if len(points) == 0:
            return EvaluationFuture.of(lambda: values_without_points(fn, points, aux))
        job = self._job(fn, points.clone(), [one.clone() for one in aux])  # the caller may write to them
        self._queue(job)
        return job.future

    @property
    def lost(self) -> dict[int, str]:
        """Points of the last call of this thread that have no value, by number, and why."""
        found: dict[int, str] = getattr(self._calls, "lost", {})
        return found

    def close(self) -> None:
        """End all workers, and with them all calls: those under way raise RuntimeError."""
        with self._lock:
            self._closed = True
            self._news.put(None)
        self._wake()
        with self._serving, self._taking:  # once the round under way has ended, and no black box is being sent
            self._fail(self._taken())
            self._end()

    @abstractmethod
    def _sent(self, fn: Callable[..., Any]) -> Any:
        """Return what workers get of a black box, or raise why they cannot have it."""

    @abstractmethod
    def _batch(self, points: Tensor) -> Batch:
        """Return points [K, n] in chunks."""

    @abstractmethod
    def _round(self, jobs: Sequence[Job]) -> None:
        """Give chunks to workers, wait until one has news or `_wake` is called, and take them."""

    @abstractmethod
    def _give_up(self, jobs: Sequence[Job]) -> None:
        """Let nobody work on these jobs any more."""

    @abstractmethod
    def _end(self) -> None:
        """End all workers; again is no error."""

    def _wake(self) -> None:
        """Let the round that is under way end soon."""

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError(f"the {type(self).__name__} is closed: make another one")

    def _alone(self) -> None:
        """Have no thread, and no calls."""
        # reentrant, because a callback or a signal handler may close the evaluator
        self._serving, self._taking = threading.RLock(), threading.RLock()
        self._thread: threading.Thread | None = None
        self._lock = threading.RLock()
        self._inbox: deque[Job] = deque()
        self._news: SimpleQueue[Ahead | None] = SimpleQueue()
        """For the thread: this evaluator for each call in the inbox, None to end."""
        self._calls = threading.local()

    def _job(self, fn: Callable[..., Any], points: Tensor, aux: Sequence[Tensor]) -> Job:
        with self._taking:
            self._check_open()
            number = next((number for number, one in self._functions.items() if same(one.fn, fn)), None)
            if number is None:
                function = Function(fn, self._sent(fn))
                make_room(self._functions)
                self._functions[function.number] = function
            else:
                function = used(self._functions, number)
        tensors = tuple(one.detach().cpu() for one in (points, *aux))
        return Job(function, tensors, points.device, self._batch(tensors[0]))

    def _queue(self, job: Job) -> None:
        """Leave a job to the thread that serves all calls."""
        with self._lock:
            self._check_open()
            if self._thread is None:
                having = self._news, self._serving  # not the evaluator, so that it ends when nobody uses it
                thread = threading.Thread(target=_serve, args=having, name="torch_zerohess evaluator", daemon=True)
                thread.start()
                self._thread = thread
                weakref.finalize(self, self._news.put, None).atexit = False
            self._inbox.append(job)
            self._news.put(self)
        self._wake()

    def _taken(self) -> list[Job]:
        """Return the jobs of the inbox, which has none from now on."""
        with self._lock:
            jobs = list(self._inbox)
            self._inbox.clear()
        return jobs

    def _serve_alone(self, job: Job) -> None:
        """Serve a call in this thread, as long as it is the only one."""
        try:
            while not (job.over or self._closed or self._thread):
                self._round([job])
        except BaseException:  # Ctrl-C: nobody waits for what the workers do
            self._give_up([job])
            raise
        with self._lock:
            if not (job.over or self._closed):
                self._inbox.appendleft(job)  # it was the first
                return
        if job.over:
            self._give_up([job])
            job.settle()
        else:
            self._fail([job])

    def _await(self, job: Job) -> None:
        try:
            job.future.exception()
        except BaseException as error:  # Ctrl-C
            job.error = error
            self._wake()
            raise

    def _serve(self) -> None:
        """Serve the calls of the inbox, and those that come meanwhile."""
        jobs = self._taken()
        while jobs and not self._closed:
            try:
                if any(not job.over for job in jobs):
                    self._round(jobs)
            except BaseException as error:
                for job in jobs:
                    job.error = error
            ended = [job for job in jobs if job.over]
            jobs = [job for job in jobs if job not in ended]
            self._give_up(ended)
            _settle(ended)
            jobs += self._taken()
        self._fail(jobs)

    def _fail(self, jobs: Sequence[Job]) -> None:
        """End jobs, because the evaluator is closed."""
        self._give_up(jobs)
        for job in jobs:
            job.future.cancel()  # if it has not begun
            job.error = RuntimeError(f"the {type(self).__name__} was closed before the values were there")
        _settle(jobs)


def _serve(news: "SimpleQueue[Ahead | None]", serving: "threading.RLock") -> None:
    """Serve all calls of an evaluator in this thread, until the evaluator is closed, or nobody has it."""
    with serving:  # once the call under way has been handed over
        while (evaluator := news.get()) is not None:
            evaluator._serve()
            del evaluator


def _settle(jobs: Sequence[Job]) -> None:
    for job in jobs:
        with contextlib.suppress(BaseException):  # of a callback: the other calls still wait for whoever serves
            job.settle()
