"""Processes that run jobs, one thread each; a process that dies takes only its own job with it."""

import signal
import time
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import torch

from experiments.ensembles.spread import BlackBoxOf, spread
from experiments.methods import METHODS, Method
from experiments.problems import catalogue
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset, Task
from experiments.runs.attempt import attempt
from experiments.runs.records import Files, Outcome, Preparation, Record, write_outcome
from torch_zerohess.evaluators import Factory, ProcessPool
from torch_zerohess.evaluators.lifetime import end_with_parent, ending, started_worker

_PROGRESS = 0.2
"""Seconds between two messages about a running job."""
_OUTSIDE = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
"""Signals from outside: a process killed by one says nothing about the method."""


@dataclass(frozen=True)
class Job:
    """One run of a method on a task; both by name, or as objects that can be pickled."""

    task: str | Task | NetworkTask
    method: str | Method
    run: int
    folder: Path
    preset: Preset
    variant: str
    limit: float | None
    settings: dict[str, Any]
    """Written to the outcome."""
    method_settings: Any
    """Given to the method."""
    budget: int
    """Evaluations of the task."""
    threads: int | None = None
    """That render the images of a network task; all cores if None."""
    workers: int | None = None
    """Further processes, in which the black box is evaluated; if None, it is evaluated in the process of the job."""

    @property
    def task_name(self) -> str:
        return self.task if isinstance(self.task, str) else self.task.name

    @property
    def method_name(self) -> str:
        return self.method if isinstance(self.method, str) else self.method.name

    @property
    def resolved_method(self) -> Method:
        return METHODS[self.method] if isinstance(self.method, str) else self.method

    @property
    def files(self) -> Files:
        return Files(self.folder / self.task_name / self.method_name, self.run)


@dataclass(frozen=True)
class Trouble:
    """A job that could not be run, for a reason outside of the method."""

    reason: str


Message = Preparation | Record | Outcome | Trouble


def run_jobs(jobs: Sequence[Job], count: int) -> Iterator[tuple[Job, Message]]:
    """Run jobs in `count` processes; yield their progress, and for each job an outcome or trouble at its end."""
    waiting = deque(jobs)
    processes: list[_Process] = []
    alone = all(job.workers is None for job in jobs)
    try:
        while waiting or any(one.job for one in processes):
            processes = [one for one in processes if one.process.is_alive() or one.job]
            while waiting and len(processes) < count:
                processes.append(_Process(daemon=alone))
            for one in processes:
                if one.job is None and waiting:
                    one.give(waiting.popleft())
            ready = wait([one.connection for one in processes if one.job])
            for one in [one for one in processes if one.connection in ready]:
                yield from one.messages()
    finally:
        for one in processes:
            one.process.kill()
            one.process.join()


class _Process:
    """A process, the pipe to it, and its job if it has one."""

    def __init__(self, daemon: bool) -> None:
        # a daemon has no children
        self.process, self.connection = started_worker(_work, "experiments job", daemon=daemon)
        self.job: Job | None = None
        self._started = False

    def give(self, job: Job) -> None:
        self.job = job
        try:
            self.connection.send(job)
        except BrokenPipeError:
            self.process.join()
            raise RuntimeError(f"a process for jobs ended with code {self.process.exitcode} between its jobs") from None

    def messages(self) -> Iterator[tuple[Job, Message]]:
        """Yield what has arrived; the last message of a job leaves the process without one."""
        assert self.job is not None
        try:
            message: Message | None = self.connection.recv()
        except (EOFError, OSError):
            self.process.join()
            if not self._started:
                raise RuntimeError(f"a process for jobs ended with code {self.process.exitcode} at its start") from None
            message = _death(self.job, self.process.exitcode or 0)
        if message is None:
            self._started = True
            return
        job = self.job
        if isinstance(message, Outcome | Trouble):
            self.job = None
        yield job, message


def _death(job: Job, code: int) -> Outcome | Trouble:
    """Return what the death of a process means for its job: a crash is the method's, a kill is not."""
    if -code in _OUTSIDE:
        return Trouble(f"its process was killed by {ending(code)}; the same command goes on with it")
    names = job.task_name, job.method_name, job.run
    outcome = Outcome(*names, "failed", f"its process ended with {ending(code)}", 0.0, 0.0, 0, 0, [], job.settings)
    write_outcome(outcome, job.files)
    return outcome


def _work(connection: Connection) -> None:
    """Run jobs until the pipe is closed."""
    end_with_parent()  # a parent that was killed may be started again, and writes the same files
    torch.set_num_threads(1)
    connection.send(None)
    while True:
        try:
            job: Job = connection.recv()
        except EOFError:
            return
        connection.send(_execute(job, connection))


def _execute(job: Job, connection: Connection) -> Message:
    last = 0.0
    held: Preparation | Record | None = None

    def watch(progress: Preparation | Record) -> None:
        nonlocal last, held
        now, held = time.monotonic(), progress
        if now - last > _PROGRESS:
            connection.send(progress)
            last, held = now, None

    try:
        task = _load(job.task, job.preset, job.variant, job.threads) if isinstance(job.task, str) else job.task
        task = catalogue.budgeted(task, job.budget)
        if job.workers is not None:
            task = spread(task, *_carrier(job.workers, job.task, job.preset, job.variant, job.threads))
        method = job.resolved_method
        method.load()
        outcome = attempt(
            task,
            method.name,
            job.run,
            lambda trial: method(trial, job.method_settings),
            job.folder,
            limit=job.limit,
            settings=job.settings,
            watch=watch,
            preparing=watch,
            parallel=job.workers is not None,
        )
    except Exception as error:
        return Trouble(f"{type(error).__name__}: {error}")
    if held is not None:  # how far it came
        connection.send(held)
    return outcome


@lru_cache(maxsize=1)  # a scene that stays loaded slows down the next
def _load(name: str, preset: Preset, variant: str, threads: int | None) -> Task | NetworkTask:
    return catalogue.load(name, preset, variant, threads)


_carriers: dict[tuple[Any, ...], tuple[ProcessPool, Factory]] = {}


def _carrier(workers: int, *source: Any) -> tuple[ProcessPool, Factory]:
    """Return the processes for `BlackBoxOf(*source)`, and its factory; the processes of another source end."""
    key = workers, *source
    if key not in _carriers:
        while _carriers:
            _carriers.popitem()[1][0].close()
        _carriers[key] = ProcessPool(workers), Factory(BlackBoxOf, *source)
    return _carriers[key]
