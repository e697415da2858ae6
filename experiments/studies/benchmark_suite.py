"""What studies on suites of problems that others wrote share: methods, runs that start again, and what is written."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from experiments.methods import METHODS
from experiments.methods.method import Method
from experiments.methods.restarts import starts
from experiments.methods.settings import space
from experiments.problems.catalogue import chosen
from experiments.problems.task import Task
from experiments.reports import data_profiles
from experiments.reports.result_files import keep
from experiments.reports.tables import table
from experiments.runs.attempt import attempt
from experiments.runs.records import Outcome
from experiments.runs.trial import Trial
from experiments.studies.tune import choices_of

Settings = tuple[tuple[str, Any], ...]
"""Settings of a method that are not its defaults."""
Profiles = Mapping[str, Mapping[str, data_profiles.Profile]]
"""Evaluations until targets were reached, and the number of all targets, by panel and by method."""


@dataclass(frozen=True)
class Suite:
    """Methods of a study, and how its table and picture are written."""

    ours: Method
    rivals: tuple[str, ...]
    """Those that it compares by default."""
    settings: Mapping[str, Mapping[str, Any]]
    """Chosen for methods whose defaults are not the best."""
    headers: tuple[str, ...]
    reached: str
    """What is counted, as "problems solved"."""
    unit: str
    """Of the evaluations, as "n"."""

    def method(self, name: str) -> Method:
        """Return ours or any method of the harness."""
        return self.ours if name == self.ours.name else METHODS[name]

    def wanted(self, methods: str, over: Sequence[str]) -> list[tuple[str, Settings]]:
        """Return methods with their settings. SystemExit names unknown methods and missing packages.

        Args:
            methods: names separated by commas, or "all": ours and the rivals.
            over: settings of a single method to compare, `name=value,value`; all combinations are returned.
        """
        everything = (self.ours.name, *self.rivals)
        known = (self.ours.name, *METHODS)
        names = everything if methods.strip() == "all" else chosen("methods", methods.split(","), known)
        for name in names:
            if missing := self.method(name).missing():
                raise SystemExit(f"{name} needs pip install {' '.join(missing)}")
        if not over:
            return [(name, tuple(self.settings.get(name, {}).items())) for name in names]
        if len(names) != 1:
            raise SystemExit(f"over compares settings of one method, got methods {','.join(names)}")
        choices = dict(choices_of(one, list(space(names[0], 1.0))) for one in over)
        combined = itertools.product(*choices.values())
        return [(names[0], tuple(zip(choices, values, strict=True))) for values in combined]

    def conclude(
        self, rows: Sequence[Sequence[object]], profiles: Profiles, budget: int, out: Path, store: str | None
    ) -> None:
        """Print the table, draw data profiles into OUT/profiles.png, and store the table if it has a name.

        Args:
            rows: of the table.
            profiles: by panel and by method.
            budget: evaluations over the unit that a run may use.
            out: folder of the picture.
            store: name of the stored table, None if it is not to be stored.
        """
        print(table(self.headers, rows))
        path = out / "profiles.png"
        data_profiles.draw(profiles, self.reached, self.unit, budget, path)
        print(path)
        if store is not None:
            print(keep(self.headers, rows, store))


def solve(task: Task, method: Method, run: int, limit: float, settings: Mapping[str, Any] | None = None) -> Outcome:
    """Run a method; where it ends by itself, again from a random point, until the task's evaluations are used.

    SystemExit has the traceback of a method that fails.
    """

    def again(trial: Trial) -> None:
        for start in starts(trial):
            trial.start = start
            method(trial, settings)

    outcome = attempt(task, method.name, run, again, limit=limit)
    if outcome.status == "failed":
        raise SystemExit(f"{method.name} failed on {task.name}: {outcome.reason}\n{outcome.traceback}")
    return outcome


def row_name(method: str, settings: Settings) -> str:
    """Return the name of a method in a table, with settings that are not its defaults."""
    return " ".join([method, *(f"{name}={value}" for name, value in settings)])
