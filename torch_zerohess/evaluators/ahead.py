"""Calls that do not wait for each other: `submit` returns a future, and the points of all calls share the workers.

A call alone is served by the thread that made it. The first `submit` starts a thread that serves all calls from then
on, in rounds: give points to workers, wait until one of them has news, take it. Calls are begun in their order, so the
values of an early one come early. The bits of a call are those that it would have alone.
"""

import concurrent.futures
import itertools
import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.evaluators.batch import Batch
from torch_zerohess.evaluators.factory import same
from torch_zerohess.evaluators.inline import Closing, Evaluation
from torch_zerohess.evaluators.values import checked_values


@dataclass(eq=False)
class Function:
    """A black box, and what workers get of it."""

    fn: Callable[..., Any]
    sent: Any
    known: tuple[torch.dtype, torch.Size] | None = None
    """Type and shape [*out] of its values, as soon as there are some."""
    number: int = field(default_factory=itertools.count().__next__)


@dataclass(eq=False)
class Job:
    """A call: its points, and what is known of their values."""

    function: Function
    tensors: tuple[Tensor, ...]
    """Points [K, n] and aux [K, ...], on the CPU."""
    device: torch.device
    batch: Batch
    future: Evaluation = field(default_factory=Evaluation)
    error: BaseException | None = None
    """Why the call fails, whatever its points do."""
    _begun: bool = False
    _cancelled: bool = False

    def __post_init__(self) -> None:
        self.future.lost = self.batch.lost

    @property
    def waiting(self) -> bool:
        """Whether a chunk waits for a worker. From the first chunk on, the future cannot be cancelled."""
        return bool(not self.over and self.batch.waiting and self._begin())

    @property
    def over(self) -> bool:
        """Whether nothing more is to be done."""
        gone = self._cancelled if self._begun else self.future.cancelled()
        return gone or self.error is not None or self.batch.finished

    def settle(self) -> None:
        """Give the future its values or its error."""
        if not self._begin():
            return
        try:
            if self.error is not None:
                raise self.error
            values = self.batch.result(self.function.known)
        except BaseException as error:
            self.future.set_exception(error)
        else:
            self.function.known = values.dtype, values.shape[1:]
            self.future.set_result(values.to(self.device))

    def _begin(self) -> bool:
        """Begin, which who waits for a future that was cancelled hears; whether it was not."""
        if not self._begun:
            self._begun = True
            self._cancelled = not self.future.set_running_or_notify_cancel()
        return not self._cancelled


class Ahead(Closing, ABC):
    """An evaluator whose calls may overlap. A subclass says how a round goes."""

    def __init__(self) -> None:
        self._function: Function | None = None
        self._closed = False
        self._alone()

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Tensor:
        """Return fn(points [K, n], *aux [K, ...]), values [K, *out] on the device of the points."""
        self._check_open()
        if len(points) == 0:
            return checked_values(fn(points, *aux), points)
        if self._thread is None and self._serving.acquire(blocking=False):
            try:
                if self._thread is None:
                    return self._served(self._job(fn, points, aux))
            finally:
                self._serving.release()
        if threading.current_thread() is self._thread:
            raise RuntimeError(f"a callback of a future may submit to the {type(self).__name__}, but not wait for it")
        job = self._queued(fn, points, aux)  # another thread has a call, too
        self._await(job)
        return self._result(job)

    def submit(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Evaluation:
        """Return a `concurrent.futures.Future` of what a call with these arguments returns.

        Several may be under way: their points share the workers, in the order of the submissions. The `lost` of the
        future has the points without a value. `cancel()` works until the first point is given to a worker. `close()`
        does not wait: a future that is not done then raises RuntimeError.
        """
        self._check_open()
        if len(points) == 0:
            return Evaluation.of(lambda: checked_values(fn(points, *aux), points))
        return self._queued(fn, points, aux).future

    @property
    def lost(self) -> dict[int, str]:
        """Points of the last call of this thread that have no value, by number, and why."""
        found: dict[int, str] = getattr(self._calls, "lost", {})
        return found

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

    def _prepare(self) -> None:
        """Have what `_wake` needs; called once, before the thread starts."""

    def _wake(self) -> None:
        """Let the round that is under way end soon."""

    def _check_open(self) -> None:
        if self._closed:
            raise RuntimeError(f"the {type(self).__name__} is closed: make another one")

    def _alone(self) -> None:
        """Have no thread, and no calls."""
        self._serving, self._taking = threading.Lock(), threading.Lock()
        self._thread: threading.Thread | None = None
        self._news = threading.Condition()
        self._inbox: deque[Job] = deque()
        self._calls = threading.local()

    def _job(self, fn: Callable[..., Any], points: Tensor, aux: Sequence[Tensor]) -> Job:
        with self._taking:
            if self._function is None or not same(self._function.fn, fn):
                self._function = Function(fn, self._sent(fn))
            function = self._function
        tensors = tuple(one.detach().cpu() for one in (points, *aux))
        return Job(function, tensors, points.device, self._batch(tensors[0]))

    def _served(self, job: Job) -> Tensor:
        """Serve a call in this thread."""
        try:
            while not job.over:
                self._round([job])
            job.settle()
        finally:  # after an error, or Ctrl-C, nobody waits for what they do
            self._give_up([job])
        return self._result(job)

    def _result(self, job: Job) -> Tensor:
        self._calls.lost = job.batch.lost
        return job.future.result()

    def _queued(self, fn: Callable[..., Any], points: Tensor, aux: Sequence[Tensor]) -> Job:
        job = self._job(fn, points.clone(), [one.clone() for one in aux])  # the caller may write to them
        if self._thread is None:
            with self._serving:  # the call of another thread ends first
                if self._thread is None:
                    self._prepare()
                    self._thread = threading.Thread(target=self._serve, name="torch_zerohess evaluator", daemon=True)
                    self._thread.start()
        with self._news:
            self._check_open()
            self._inbox.append(job)
            self._news.notify()
        self._wake()
        return job

    def _await(self, job: Job) -> None:
        try:
            job.future.exception()
        except BaseException as error:  # Ctrl-C
            job.error = error
            self._wake()
            raise

    def _serve(self) -> None:
        """Serve all calls, until the evaluator is closed."""
        jobs: list[Job] = []
        while True:
            with self._news:
                while not (self._closed or self._inbox or jobs):
                    self._news.wait()
                jobs += self._inbox
                self._inbox.clear()
            if self._closed:
                break
            try:
                if any(not job.over for job in jobs):
                    self._round(jobs)
            except BaseException as error:
                for job in jobs:
                    job.error = error
            ended = [job for job in jobs if job.over]
            self._give_up(ended)
            jobs = [job for job in jobs if job not in ended]
            for job in ended:
                job.settle()
        self._give_up(jobs)
        for job in jobs:
            job.future.cancel()  # if it has not begun
            job.error = RuntimeError(f"the {type(self).__name__} was closed before the values were there")
            job.settle()

    def _stop(self) -> None:
        """End the thread, and with it all calls."""
        with self._news:
            self._closed = True
            self._news.notify()
        self._wake()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join()


def wait_all(tasks: "Sequence[concurrent.futures.Future[Any]]", then: Callable[[], object]) -> None:
    """Call `then` once, in whichever thread, when the last of the tasks is done."""
    left, lock = len(tasks), threading.Lock()

    def one_less(_: Any) -> None:
        nonlocal left
        with lock:
            left -= 1
            last = left == 0
        if last:
            then()

    for task in tasks:
        task.add_done_callback(one_less)
