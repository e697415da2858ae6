"""`python -m experiments tune TASK`: search for settings of a method, on starts that no table reports."""

import ast
import dataclasses
import itertools
import math
import random
import statistics
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Annotated, Any

import torch
import tyro

from experiments.methods import METHODS, Method
from experiments.methods.settings import settings, space
from experiments.problems import catalogue
from experiments.problems.task import Preset, Task
from experiments.reports.progress import progress
from experiments.reports.results import Run
from experiments.reports.tables import table
from experiments.runs.attempt import attempt
from experiments.runs.records import Record
from experiments.runs.trial import LEVELS

TUNING = 1000
"""Runs from this number upward are for tuning; tables report those below."""


@dataclass(frozen=True)
class Score:
    """How a method does with some settings: the better one is the smaller one."""

    settings: dict[str, Any]
    reached: list[int | None]
    """Evaluations until the image error is reduced by `level`, by run; None where it never was."""
    failures: list[str] = field(default_factory=list)
    """Why runs failed, one for each."""

    @property
    def share(self) -> float:
        return sum(one is not None for one in self.reached) / len(self.reached)

    @property
    def median(self) -> float:
        """Over all runs, one that never gets there counting as infinite."""
        return statistics.median(math.inf if one is None else one for one in self.reached)

    @property
    def rank(self) -> tuple[float, float]:
        return -self.share, self.median


def tune(
    task: Annotated[str, tyro.conf.Positional],
    /,
    method: str,
    runs: int = 5,
    trials: int = 20,
    seed: int = 0,
    first: int = TUNING,
    level: float = 0.99,
    evaluations: int | None = None,
    preset: Preset = "fast",
    over: tuple[str, ...] = (),
    best: int = 10,
) -> None:
    """Try settings of a method drawn at random from its search space, and print the best.

    The settings in use are tried first. A setting is better than another if more runs reach the level, or as many
    with a smaller median number of evaluations. Ctrl-C prints those that were tried so far.

    Args:
        task: a fitting task.
        method: one with a search space, see `experiments.methods.settings`.
        runs: starts for each setting.
        trials: settings drawn; all of them if there are no more.
        seed: of the draw.
        first: number of the first start, at least 1000: those below are for the tables.
        level: reduction of the image error that counts, at most 0.999: runs end there.
        evaluations: of a run, at most; the number of the task if not given.
        preset: fast or paper.
        over: settings to vary and their choices, `samples=4,8 sigma=(0.2,0.1),(0.2,0.01)`; the others stay as they are
            in use. Everything in the search space varies if not given.
        best: rows of the table.
    """
    if first < TUNING:
        raise SystemExit(f"first must be at least {TUNING}: runs below are for the tables, got {first}")
    for name, value in (("runs", runs), ("trials", trials), ("evaluations", 1 if evaluations is None else evaluations)):
        if value < 1:
            raise SystemExit(f"{name} must be at least 1, got {value}")
    if not 0.0 < level <= LEVELS[-1]:
        raise SystemExit(f"level must be above 0 and at most {LEVELS[-1]:g}, where runs end, got {level}")
    torch.set_num_threads(1)
    (name,) = catalogue.chosen("task", [task], list(catalogue.FITTING))
    loaded = catalogue.fitting(name, preset)
    if evaluations is not None:
        loaded = dataclasses.replace(loaded, evaluations=evaluations)
    (chosen,) = catalogue.chosen("method", [method], list(METHODS))
    reason = METHODS[chosen].unusable(loaded)
    if reason:
        raise SystemExit(f"method must be one that can be run on {name}, got {chosen}: {reason}")
    current = settings(chosen, name)
    choices = space(chosen, loaded.sigma)
    free = dict(choices_of(one, list(choices)) for one in over) or choices
    candidates = [current, *({**current, **one} for one in draw(free, trials, seed))]
    bar = progress(candidates, f"settings of {chosen} on {name}")
    scores: list[Score] = []
    try:
        for one in bar:
            scores += [score(loaded, METHODS[chosen], one, range(first, first + runs), level)]
    except KeyboardInterrupt:
        bar.close()
        if scores:
            print(report(scores, list(choices), level, best))
        raise SystemExit(f"\ninterrupted after {len(scores)} of {len(candidates)} settings") from None
    print(report(scores, list(choices), level, best))


def choices_of(text: str, names: Sequence[str]) -> tuple[str, tuple[Any, ...]]:
    """Return a name and its choices from `name=value,value`; values are numbers, tuples of numbers or words."""
    name, _, values = text.partition("=")
    if name not in names or not values:
        raise SystemExit(f"over must be NAME=VALUE,VALUE with a name among {', '.join(names)}, got {text}")
    try:
        parsed = ast.literal_eval(f"({values},)")
    except (SyntaxError, ValueError):
        parsed = tuple(values.split(","))
    return name, parsed


def draw(choices: Mapping[str, Sequence[Any]], count: int, seed: int) -> list[dict[str, Any]]:
    """Return `count` different combinations of choices at random, or all of them if there are no more."""
    total = math.prod(len(values) for values in choices.values())
    if total <= count:
        return [dict(zip(choices, values, strict=True)) for values in itertools.product(*choices.values())]
    found = []
    for index in random.Random(seed).sample(range(total), count):
        combination = {}
        for name, values in choices.items():
            index, which = divmod(index, len(values))
            combination[name] = values[which]
        found.append(combination)
    return found


def score(task: Task, method: Method, candidate: dict[str, Any], runs: range, level: float) -> Score:
    """Run a method from every start; a run that fails counts as far as it got."""
    reached: list[int | None] = []
    failures: list[str] = []
    for run in runs:
        rows: list[Record] = []
        outcome = attempt(task, method.name, run, lambda trial: method(trial, candidate), watch=rows.append)
        record = Run(outcome, rows).reached("image", level)
        reached.append(record.evaluations if record else None)
        if outcome.status == "failed":
            failures.append(outcome.reason)
    return Score(candidate, reached, failures)


def report(scores: Sequence[Score], names: Sequence[str], level: float, best: int) -> str:
    """Return a table of the best settings, the ones in use marked, and why runs failed."""
    ranked = sorted(enumerate(scores), key=lambda one: one[1].rank)
    chosen = [(rank, number, one) for rank, (number, one) in enumerate(ranked, 1) if rank <= best or number == 0]
    rows = [
        [
            f"{rank}{' in use' if number == 0 else ''}",
            f"{100 * one.share:.0f} %{f', {len(one.failures)} failed' if one.failures else ''}",
            None if math.isinf(one.median) else one.median,
            *(_text(one.settings.get(name)) for name in names),
        ]
        for rank, number, one in chosen
    ]
    runs = sum(len(one.reached) for one in scores)
    failures = Counter(reason for one in scores for reason in one.failures).most_common()
    lines = [f"{count} of {runs} runs failed: {reason}" for reason, count in failures]
    headers = ["rank", "share", f"median evaluations to {100 * level:g} %", *names]
    return "\n".join([table(headers, rows), *lines])


def _text(value: Any) -> str:
    if isinstance(value, tuple):
        return ", ".join(_text(one) for one in value)
    return "default" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
