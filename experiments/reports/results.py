"""The runs in a folder, as the tables, figures and reports read them."""

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from experiments.problems.task import Task
from experiments.runs.records import Files, Outcome, Record, read, read_outcome
from experiments.runs.trial import reduced

METRICS = ("image", "parameter")


@dataclass(frozen=True)
class Run:
    """A run that has ended, with its log."""

    outcome: Outcome
    records: list[Record]

    def error(self, metric: str) -> list[float | None]:
        """Errors of all rows, relative to the first; None where a row has none."""
        errors: list[float | None] = [getattr(record, f"{metric}_error") for record in self.records]
        first = errors[0] if errors else None
        if first is None:
            return [None] * len(errors)
        return [None if e is None else e / first if first else float(e > 0) for e in errors]

    def reached(self, metric: str, level: float) -> Record | None:
        """Return the first row whose error is reduced by `level`."""
        errors: list[float | None] = [getattr(record, f"{metric}_error") for record in self.records]
        pairs = zip(self.records, errors, strict=True)
        return next((record for record, error in pairs if reduced(error, errors[0], level)), None)


@dataclass(frozen=True)
class Results:
    """All runs of a folder by task and method, in the order of their names; those that go on are counted only."""

    folder: Path
    runs: dict[str, dict[str, list[Run]]]
    unfinished: Counter[str]
    """How many of each method."""


def load(folder: Path, tasks: Collection[str] | None = None) -> Results:
    """Read a folder, or only some of its tasks; SystemExit if it has no run that has ended."""
    if not folder.is_dir():
        raise SystemExit(f"DIR must be a folder that `python -m experiments run` has written to, got {folder}")
    runs: dict[str, dict[str, list[Run]]] = {}
    unfinished: Counter[str] = Counter()
    for task in _folders(folder):
        if tasks is not None and task.name not in tasks:
            continue
        for method in _folders(task):
            unfinished[method.name] += sum(1 for _ in method.glob("*.journal"))
            numbers = sorted(int(path.stem) for path in method.glob("*.json") if path.stem.isdigit())
            mine = [_run(Files(method, number)) for number in numbers]
            if mine:
                runs.setdefault(task.name, {})[method.name] = mine
    if not runs:
        going = f", {count} are unfinished" if (count := unfinished.total()) else ""
        raise SystemExit(f"DIR must have runs that have ended; {folder} has none{going}")
    return Results(folder, runs, unfinished)


def _folders(folder: Path) -> list[Path]:
    """Folders of tasks or methods, in the order of their names."""
    return sorted(path for path in folder.iterdir() if path.is_dir())


def _run(files: Files) -> Run:
    return Run(read_outcome(files.outcome), list(read(files.log)) if files.log.exists() else [])


def first_run(task: Task, methods: Mapping[str, Sequence[Run]]) -> tuple[int, dict[str, Tensor]]:
    """Return the number of the first run, its start [n] under "start", and where each method ended from there [n]."""
    run = min(one.outcome.run for runs in methods.values() for one in runs)
    ends = {
        name: torch.tensor(one.outcome.x, dtype=torch.float64)
        for name, runs in methods.items()
        for one in runs
        if one.outcome.run == run and len(one.outcome.x) == task.n
    }
    return run, {"start": task.start(run), **ends}
