"""Many runs: every method on every task from the same starts, resumed where they were, behind one progress bar."""

import math
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.ensembles.processes import Job, Message, Trouble, run_jobs
from experiments.ensembles.provenance import register
from experiments.methods import METHODS, Method
from experiments.methods.settings import settings as settings_of
from experiments.problems import catalogue
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset, Task
from experiments.runs.outputs import check_folder
from experiments.runs.records import Outcome, Preparation, Record, read_outcome
from experiments.runs.trial import LEVELS, LIMIT

_BAR = "{l_bar}{bar}| {n:.1f}/{total} runs [{elapsed}<{remaining}{postfix}]"


@dataclass(frozen=True)
class Ensemble:
    """Which runs there are, where they are kept and what they may use."""

    folder: Path
    runs: range
    preset: Preset = "fast"
    jobs: int = 1
    limit: float | None = None
    """Seconds of a run; if None `LIMIT`, and for a network task any."""
    variant: str = "auto"
    """Of Mitsuba."""
    network_runs: range | None = None
    """Runs on network tasks, if they are not `runs`."""
    threads: int | None = None
    """That render the images of a network task; all cores if None. A fitting task has one per process."""
    evaluations: int | None = None
    """Most evaluations of a run; the number of the task if None."""
    workers: int | None = None
    """Processes for the black box of each run, besides its own; none if None."""

    def __post_init__(self) -> None:
        for runs in (self.runs, self.network_runs or self.runs):
            if len(runs) < 1:
                raise SystemExit(f"runs must be at least 1, got {runs.stop - runs.start}")
            if runs.start < 0:
                raise SystemExit(f"seed must be at least 0, got {runs.start}")
        least = {"jobs": self.jobs, "threads": self.threads, "evaluations": self.evaluations, "workers": self.workers}
        for name, value in least.items():
            if value is not None and value < 1:
                raise SystemExit(f"{name} must be at least 1, got {value}")
        if self.limit is not None and not self.limit > 0:
            raise SystemExit(f"limit must be a positive number of seconds, got {self.limit:g}")
        check_folder(self.folder)

    def plan(
        self, tasks: Sequence[str | Task | NetworkTask], methods: Sequence[str | Method] | None = None
    ) -> list[Job]:
        """Return all jobs in the order of `ordered`.

        methods: None takes all that apply. A method that does not apply to a task, or lacks a package, is left out with
        a line that says so. Settings that differ from earlier runs in the folder are refused, and folders of a task or
        method that cannot be written.
        """
        jobs = [job for task in tasks for job in self._jobs(task, methods)]
        if not jobs:
            raise SystemExit("no method of this command can be run on these tasks")
        for folder in dict.fromkeys(job.files.folder for job in jobs):
            check_folder(folder)
        register(self.folder, settings_by_method(jobs))
        return ordered(jobs)

    def _jobs(self, task: str | Task | NetworkTask, methods: Sequence[str | Method] | None) -> list[Job]:
        preset, variant, threads = self.preset, self.variant, self.threads
        loaded = catalogue.load(task, preset, variant, threads) if isinstance(task, str) else task
        loaded = catalogue.budgeted(loaded, self.evaluations)
        network = isinstance(loaded, NetworkTask)
        shared = {"preset": preset, "variant": variant} | ({"threads": threads} if network else {"level": LEVELS[-1]})
        if self.workers is not None:
            shared["workers"] = self.workers  # seconds depend on them
        limit = LIMIT if self.limit is None and not network else self.limit
        jobs = []
        for name in [one for one, it in METHODS.items() if not it.extra] if methods is None else methods:
            method = METHODS[name] if isinstance(name, str) else name
            reason = method.unusable(loaded)
            if reason:
                if methods is not None or method.missing():
                    print(f"{method.name} is left out on {loaded.name}: {reason}", flush=True)
                continue
            own = settings_of(method.name, loaded.name)
            budget = {"limit": limit, "evaluations": loaded.evaluations, "sigma": loaded.sigma}
            settings = shared | budget | {"method": own}
            runs = self.network_runs or self.runs if network else self.runs
            fixed = self.folder, preset, variant, limit, settings, own, loaded.evaluations, threads, self.workers
            jobs += [Job(task, name, run, *fixed) for run in runs]
        return jobs

    def run(self, jobs: Sequence[Job]) -> list[Outcome]:
        """Run the jobs that have no outcome yet and return the outcomes of all.

        KeyboardInterrupt leaves everything as it is on the disk: the same call goes on there.
        """
        todo = [job for job in jobs if not job.files.outcome.exists()]
        troubles: list[tuple[Job, str]] = []
        with tqdm(total=len(jobs), initial=len(jobs) - len(todo), bar_format=_BAR, dynamic_ncols=True) as bar:
            progress = _Progress(bar)
            for job, message in run_jobs(todo, min(self.jobs, len(todo))):
                progress(job, message)
                if isinstance(message, Trouble):
                    troubles.append((job, message.reason))
        for job, reason in troubles:
            print(f"not run: {job.task_name} {job.method_name} {job.run}: {reason}", flush=True)
        return [read_outcome(job.files.outcome) for job in jobs if job.files.outcome.exists()]


def not_run(planned: Sequence[Job], outcomes: Sequence[Outcome]) -> list[str]:
    """Return a line that counts the runs without an outcome, none if all have one; `Ensemble.run` has said why."""
    count = len(planned) - len(outcomes)
    if not count:
        return []
    return [f"{count} of {len(planned)} runs could not be run; the lines that begin with `not run` have the reasons"]


class _Progress:
    """The bar: runs that ended, and of those that are running the share of evaluations they have used."""

    def __init__(self, bar: Any) -> None:
        self._bar, self._ended = bar, bar.n
        self._running: dict[tuple[str, str, int], float] = {}
        self._first: dict[tuple[str, str, int], float | None] = {}
        self._interval, self._drawn = 0.1 if sys.stderr.isatty() else 30.0, -math.inf

    def __call__(self, job: Job, message: Message) -> None:
        key = job.task_name, job.method_name, job.run
        name = " ".join(map(str, key))
        if isinstance(message, Preparation):
            self._bar.set_postfix_str(f"{name}: {message.done} of {message.total} images rendered", refresh=False)
        elif isinstance(message, Record):
            self._running[key] = min(message.evaluations / job.budget, 1.0)
            first = self._first.setdefault(key, message.image_error)
            if first and message.image_error is not None:
                error = 100 * message.image_error / first
                self._bar.set_postfix_str(f"{name}: error {error:.3g} %", refresh=False)
        else:
            self._ended += 1
            self._running.pop(key, None)
        self._bar.n = self._ended + sum(self._running.values())
        if time.monotonic() - self._drawn > self._interval:
            self._bar.refresh()
            self._drawn = time.monotonic()


def settings_by_method(jobs: Iterable[Job]) -> dict[str, dict[str, Any]]:
    """Return the settings of jobs by task and method, as `register` takes them."""
    found: dict[str, dict[str, Any]] = {}
    for job in jobs:
        found.setdefault(job.task_name, {})[job.method_name] = job.settings
    return found


def ordered(jobs: Iterable[Job]) -> list[Job]:
    """Return jobs task by task, since every scene that a process has loaded slows down all of them.

    The jobs of a task are in the order of their runs, so that an ensemble that is stopped has about as many runs of
    each method. Methods that load another scene come last.
    """
    position: dict[str, int] = {}

    def key(job: Job) -> tuple[int, bool, int]:
        return position.setdefault(job.task_name, len(position)), job.resolved_method.another_scene, job.run

    return sorted(jobs, key=key)
