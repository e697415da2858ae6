"""`python -m experiments robustness`: how methods do when starts, samples, noise or the reference are other ones.

The sweeps of the source (supplement, Sec. I) and two more. Each value of a sweep is a task of its own with a name that
says what differs, run and logged as any other, so that `table`, `plot` and `report` read the folder too. What is the
same in several sweeps is run once. Errors are measured on the unchanged task, see `experiments.problems.variations`.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from experiments.arguments import OptionalTasks
from experiments.ensembles.ensemble import Ensemble, not_run, ordered, settings_by_method
from experiments.ensembles.processes import Job
from experiments.ensembles.provenance import register
from experiments.methods import METHODS
from experiments.methods.settings import settings as settings_of
from experiments.problems.catalogue import FITTING, check_variant, chosen
from experiments.problems.task import Preset
from experiments.problems.variations import Change
from experiments.problems.variations import load as load_varied
from experiments.reports import robustness_curves
from experiments.reports.medians import MEASURES, medians, objects, reached
from experiments.reports.results import Results, Run, load
from experiments.reports.tables import table
from experiments.runs.trial import LEVELS, LIMIT

LEVEL = LEVELS[1]
"""The one that evaluations and seconds are counted to."""


@dataclass(frozen=True)
class Sweep:
    """Values of one circumstance, and what each of them changes."""

    title: str
    values: tuple[Any, ...]
    change: Callable[[Any], Change]
    read: Callable[[str], Any]
    """Value of a text."""


def _quality(text: str) -> int | None:
    return None if text == "none" else int(text)


_FACTORS = (0.25, 0.5, 1.0, 2.0, 3.0)
SWEEPS = {
    "start": Sweep(
        "distance of the start",
        (0.5, 0.75, 1.0, 1.25, 1.5, 2.0),
        lambda value: Change(start=value),
        float,
    ),
    "pairs": Sweep("antithetic pairs", (1, 2, 4, 6, 8, 10), lambda value: Change(pairs=value), int),
    "spp": Sweep("samples per pixel", _FACTORS, lambda value: Change(spp=value), float),
    "noisy_spp": Sweep(
        "samples per pixel, fresh noise", _FACTORS, lambda value: Change(spp=value, noise="point"), float
    ),
    "jpeg": Sweep(
        "JPEG quality of the reference", (None, 95, 75, 50, 30, 10, 2), lambda value: Change(jpeg=value), _quality
    ),
    "noise": Sweep("seed of the renders", ("fixed", "other", "call", "point"), lambda value: Change(noise=value), str),
}
"""By name. Starts and samples per pixel are factors; a factor of 1 is the value of the task."""


@dataclass(frozen=True)
class Cell:
    """A method at one value of a sweep, and the name of the task that this is."""

    task: str
    sweep: str
    value: str
    method: str
    varied: str


@dataclass(frozen=True)
class Row:
    """Medians over the runs of a cell. The median of evaluations and seconds is over those that got there, and there is
    none if these are fewer than half; of the errors at the end it is over all.
    """

    task: str
    sweep: str
    value: str
    method: str
    runs: int
    share_90: float
    """Of the runs that reduced the image error by 90 %."""
    share_99: float
    evaluations_99: float | None
    evaluations_99_low: float | None
    evaluations_99_high: float | None
    """Quartiles."""
    seconds_99: float | None
    seconds_99_low: float | None
    seconds_99_high: float | None
    image_error: float | None
    """At the end, over that at the start."""
    parameter_error: float | None
    """At the end: root mean square, in the units of the task."""


def robustness(
    tasks: OptionalTasks = ("mug", "shad"),
    /,
    methods: str = "gaussian_process,our_hvpa",
    over: tuple[str, ...] = tuple(SWEEPS),
    runs: int = 5,
    preset: Preset = "fast",
    out: Path = Path("results/robustness"),
    jobs: int = 1,
    seed: int = 0,
    limit: float = LIMIT,
    evaluations: int | None = None,
    variant: str = "auto",
) -> list[Row]:
    """Run methods under other circumstances and print, draw and save how they did; the same command goes on with it.

    Sweeps are start (distance from the solution), pairs (antithetic pairs of methods that have such a setting), spp
    (samples per pixel of renders and reference), noisy_spp (the same, every render with a new seed), jpeg (quality of
    the reference) and noise (seed of the renders: fixed to the seed of the reference, other, new for every call or
    point). Only start and pairs apply to tasks that are not rendered.

    Args:
        tasks: names, see `list`.
        methods: names separated by commas.
        over: sweeps, with values if not the usual ones: `spp=0.5,1 jpeg=none,10`.
        runs: starts for each value.
        preset: fast or paper.
        out: folder for logs, robustness.csv and figures.
        jobs: processes, one thread each.
        seed: number of the first run.
        limit: seconds that a run may take.
        evaluations: of a run, at most; the number of the task if not given.
        variant: of Mitsuba.
    """
    if evaluations is not None and evaluations < 1:
        raise SystemExit(f"evaluations must be at least 1, got {evaluations}")
    names = chosen("TASK", tasks, list(FITTING))
    wanted = chosen("methods", methods.split(","), list(METHODS))
    sweeps = dict(_sweep(one) for one in over)
    check_variant(variant, names)
    ensemble = Ensemble(out, range(seed, seed + runs), preset, jobs, limit, variant)
    try:
        planned = [one for name in names for one in plan(ensemble, name, wanted, sweeps, evaluations)]
        if not planned:
            raise SystemExit("no sweep of this command applies to these tasks and methods")
        todo = {(one.varied, one.method, job.run): job for one, many in planned for job in many}
        register(out, settings_by_method(todo.values()))
        wanted_runs = ordered(todo.values())
        outcomes = ensemble.run(wanted_runs)
    except KeyboardInterrupt:
        raise SystemExit(f"\ninterrupted; the same command goes on where it was, logs are in {out}") from None
    missing = not_run(wanted_runs, outcomes)
    if not outcomes:
        raise SystemExit("\n".join(missing))
    cells = [cell for cell, _ in planned]
    results = load(out, {cell.varied for cell in cells})
    found = {cell: _runs(results, cell, ensemble.runs) for cell in cells}
    rows = [row(cell, runs) for cell, runs in found.items() if runs]
    print("\n" + as_text(rows))
    pd.DataFrame(rows).to_csv(out / "robustness.csv", index=False, lineterminator="\n")
    print(f"\n{out / 'robustness.csv'}")
    for name in names:
        mine = [(cell.method, cell.sweep, cell.value, runs) for cell, runs in found.items() if cell.task == name]
        titles = {sweep: SWEEPS[sweep].title for sweep in sweeps}
        for against in ("evaluations", "seconds"):
            path = out / f"{name}-robustness-{against}.png"
            robustness_curves.draw(name, mine, titles, against, path)
            print(path)
    if missing:
        raise SystemExit("\n".join(missing))
    return rows


def _sweep(text: str) -> tuple[str, Sequence[Any]]:
    """Return name and values of `name` or `name=value,value`."""
    name, given, values = text.partition("=")
    (name,) = chosen("over", [name], list(SWEEPS))
    try:
        found = [SWEEPS[name].read(value.strip()) for value in values.split(",")] if given else SWEEPS[name].values
        for value in found:
            SWEEPS[name].change(value)
    except ValueError as error:
        raise SystemExit(f"over must be NAME or NAME=VALUE,VALUE, got {text}: {error}") from None
    return name, found


def plan(
    ensemble: Ensemble, name: str, methods: Sequence[str], sweeps: dict[str, Sequence[Any]], evaluations: int | None
) -> Iterator[tuple[Cell, list[Job]]]:
    """Yield the cells of a task with their jobs; what does not apply is left out with a line that says so."""
    for sweep, values in sweeps.items():
        for method in methods:
            own = settings_of(method, name)
            if sweep == "pairs" and "samples" not in own:
                print(f"{method} has no number of pairs on {name}: left out of that sweep", flush=True)
                continue
            for value in values:
                change = SWEEPS[sweep].change(value)
                if change.pairs is not None and change.pairs == own["samples"]:
                    change = Change()
                try:
                    jobs = _jobs(ensemble, name, method, own, change, evaluations)
                except ValueError as error:
                    print(f"{method}, {sweep} = {_text(sweep, value)} is left out on {name}: {error}", flush=True)
                    continue
                yield Cell(name, sweep, _text(sweep, value), method, jobs[0].task_name), jobs


def _jobs(
    ensemble: Ensemble, name: str, method: str, own: dict[str, Any], change: Change, evaluations: int | None
) -> list[Job]:
    """Return a job per run; ValueError says why this is not possible."""
    task = load_varied(name, ensemble.preset, ensemble.variant, evaluations, change)
    reason = METHODS[method].unusable(task)
    if reason:
        raise ValueError(reason)
    if task.bounds:
        lower, upper = task.bounds
        for run in ensemble.runs:
            start = task.start(run)
            if not bool(((lower <= start) & (start <= upper)).all()):
                raise ValueError(f"the start of run {run} would be out of the bounds")
    own = own if change.pairs is None else {**own, "samples": change.pairs}
    settings = {
        "preset": ensemble.preset,
        "variant": ensemble.variant,
        "level": LEVELS[-1],
        "limit": ensemble.limit,
        "evaluations": task.evaluations,
        "sigma": task.sigma,
        "change": asdict(change),
        "method": own,
    }
    given = (ensemble.preset, ensemble.variant, ensemble.limit, settings, own, task.evaluations)
    return [Job(task, method, run, ensemble.folder, *given) for run in ensemble.runs]


def _runs(results: Results, cell: Cell, numbers: range) -> list[Run]:
    """Return the runs of this command: the folder may have more runs of some cells."""
    return [one for one in results.runs.get(cell.varied, {}).get(cell.method, []) if one.outcome.run in numbers]


def _text(sweep: str, value: Any) -> str:
    if sweep in ("start", "spp", "noisy_spp"):
        return f"{value:g}x"
    return "none" if value is None else str(value)


def row(cell: Cell, runs: Sequence[Run]) -> Row:
    """Return the medians of the runs of a cell."""
    there = medians(reached([((), runs)], ()), ("metric", "level"))
    first, second = objects(there[(there["metric"] == "image") & there["level"].isin([LEVELS[0], LEVEL])])
    ends = [
        (_at_end(run.error("image")), _at_end([record.parameter_error for record in run.records]))
        for run in runs
        if run.records
    ]
    errors = pd.DataFrame(ends, columns=["image", "parameter"], dtype=float)
    image, parameter = errors["image"].median(), errors["parameter"].pow(0.5).median()
    evaluations, seconds = ([second[f"{name}{end}"] for end in ("", "_low", "_high")] for name in MEASURES)
    return Row(
        *(cell.task, cell.sweep, cell.value, cell.method, len(runs), first["share"], second["share"]),
        *(evaluations[0], evaluations[1], evaluations[2], seconds[0], seconds[1], seconds[2]),
        None if math.isnan(image) else float(image),
        None if math.isnan(parameter) else float(parameter),
    )


def _at_end(errors: Sequence[float | None]) -> float:
    """Return the last error: infinite for a run that diverged, NaN where the task has no such error."""
    if errors[0] is None:
        return math.nan
    return math.inf if errors[-1] is None else errors[-1]


def as_text(rows: Sequence[Row]) -> str:
    """Return a table for every task and sweep."""
    headers = ["value", "method", "runs", "90 %", "99 %", "evaluations to 99 %", "seconds"]
    headers += ["image error at the end", "parameter error"]
    parts = []
    for task, sweep in dict.fromkeys((one.task, one.sweep) for one in rows):
        mine = [one for one in rows if (one.task, one.sweep) == (task, sweep)]
        cells = [
            [
                *(one.value, one.method, one.runs, f"{100 * one.share_90:.0f}%", f"{100 * one.share_99:.0f}%"),
                *(one.evaluations_99, one.seconds_99, one.image_error, one.parameter_error),
            ]
            for one in mine
        ]
        parts.append(f"{task}, {SWEEPS[sweep].title}\n{table(headers, cells)}")
    return "\n\n".join(parts)
