"""Many runs: every method on every task from the same starts, resumed where they were, behind one progress bar."""

import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tqdm import tqdm

from experiments.ensembles.provenance import register
from experiments.ensembles.workers import Job, Trouble, run_jobs
from experiments.methods import METHODS, Method
from experiments.methods.settings import settings as settings_of
from experiments.problems import catalogue
from experiments.problems.catalogue import Preset
from experiments.problems.task import Task
from experiments.runs.records import Outcome, Record, read_outcome
from experiments.runs.trial import LEVELS, LIMIT

_BAR = "{l_bar}{bar}| {n:.1f}/{total} runs [{elapsed}<{remaining}{postfix}]"


@dataclass(frozen=True)
class Ensemble:
    """Which runs there are, where they are kept and what they may use."""

    folder: Path
    runs: range
    preset: Preset = "fast"
    jobs: int = 1
    limit: float = LIMIT
    variant: str = "auto"
    """Of Mitsuba."""

    def __post_init__(self) -> None:
        if len(self.runs) < 1:
            raise SystemExit(f"runs must be at least 1, got {len(self.runs)}")
        if self.runs.start < 0:
            raise SystemExit(f"seed must be at least 0, got {self.runs.start}")
        if self.jobs < 1:
            raise SystemExit(f"jobs must be at least 1, got {self.jobs}")
        if not self.limit > 0:
            raise SystemExit(f"limit must be a positive number of seconds, got {self.limit:g}")

    def plan(self, tasks: Sequence[str | Task], methods: Sequence[str | Method] | None = None) -> list[Job]:
        """Return all jobs in the order of `ordered`.

        methods: None takes all that apply. One that does not apply to a task, or lacks a package, is left out with a
        line that says so. Settings that differ from those of earlier runs in the folder are refused.
        """
        jobs = [job for task in tasks for job in self._jobs(task, methods)]
        if not jobs:
            raise SystemExit("no method of this command can be run on these tasks")
        table: dict[str, dict[str, Any]] = {}
        for job in jobs:
            table.setdefault(job.task_name, {})[job.method_name] = job.settings
        register(self.folder, table)
        return ordered(jobs)

    def _jobs(self, task: str | Task, methods: Sequence[str | Method] | None) -> list[Job]:
        loaded = catalogue.load(task, self.preset, self.variant) if isinstance(task, str) else task
        jobs = []
        for name in METHODS if methods is None else methods:
            method = METHODS[name] if isinstance(name, str) else name
            reason = unusable(method, loaded)
            if reason:
                if methods is not None or method.missing():
                    print(f"{method.name} is left out on {loaded.name}: {reason}", flush=True)
                continue
            own = settings_of(method.name, loaded.name)
            settings = {
                "preset": self.preset,
                "variant": self.variant,
                "level": LEVELS[-1],
                "limit": self.limit,
                "evaluations": loaded.evaluations,
                "sigma": loaded.sigma,
                "method": own,
            }
            jobs += [
                Job(
                    task,
                    name,
                    run,
                    self.folder,
                    self.preset,
                    self.variant,
                    self.limit,
                    settings,
                    own,
                    loaded.evaluations,
                )
                for run in self.runs
            ]
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


class _Progress:
    """The bar: runs that ended, and of those that are running the share of evaluations they have used."""

    def __init__(self, bar: Any) -> None:
        self._bar, self._ended = bar, bar.n
        self._running: dict[tuple[str, str, int], float] = {}
        self._first: dict[tuple[str, str, int], float | None] = {}
        self._interval, self._drawn = 0.1 if sys.stderr.isatty() else 30.0, 0.0

    def __call__(self, job: Job, message: Record | Outcome | Trouble) -> None:
        key = job.task_name, job.method_name, job.run
        if isinstance(message, Record):
            self._running[key] = min(message.evaluations / job.budget, 1.0)
            first = self._first.setdefault(key, message.image_error)
            if first and message.image_error is not None:
                error = 100 * message.image_error / first
                self._bar.set_postfix_str(f"{' '.join(map(str, key))}: error {error:.3g} %", refresh=False)
        else:
            self._ended += 1
            self._running.pop(key, None)
        self._bar.n = self._ended + sum(self._running.values())
        if time.monotonic() - self._drawn > self._interval:
            self._bar.refresh()
            self._drawn = time.monotonic()


def ordered(jobs: Iterable[Job]) -> list[Job]:
    """Return jobs task by task, since every scene that a process has loaded slows down all of them.

    Those of a task are run by run, so that an ensemble that is stopped has about as many of each method; methods that
    load another scene come last.
    """
    position: dict[str, int] = {}

    def key(job: Job) -> tuple[int, bool, int]:
        method = METHODS[job.method] if isinstance(job.method, str) else job.method
        return position.setdefault(job.task_name, len(position)), method.another_scene, job.run

    return sorted(jobs, key=key)


def unusable(method: Method, task: Task) -> str | None:
    """Return why a method cannot be run on a task, None if it can."""
    missing = method.missing()
    return f"needs pip install {' '.join(missing)}" if missing else method.applies(task)
