"""`python -m experiments store DIR --name NAME`: the medians of a folder of results as a table that documents quote."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pandas as pd
import torch

from experiments.arguments import Folder
from experiments.ensembles.provenance import read_command
from experiments.methods import METHODS
from experiments.problems.catalogue import FITTING, NETWORKS, RENDERED, chosen, fitting
from experiments.problems.catalogue import load as load_task
from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset
from experiments.reports import result_files
from experiments.reports.medians import medians, reached
from experiments.reports.networks import HELD_OUT, per_method, until_reduced
from experiments.reports.results import Results, Run, load
from experiments.runs.trial import LEVELS

_ALIKE = ("preset", "limit", "clock", "first_run", "runs", "commit", "machine")
"""What rows of one table have in common."""


def store(
    folder: Folder,
    /,
    name: str,
    tasks: tuple[str, ...] = (),
    levels: tuple[float, ...] = LEVELS,
    add: bool = False,
    failed: bool = False,
) -> None:
    """Write the medians of a folder of results, with their origin, to experiments/results/NAME.csv.

    A fitting task has a row per method, error and level. A task that trains a network has a row per method. Rows say
    how many evaluations a run may use (`evaluation_limit`) and how many runs the limit of time ended. Refused if
    the runs are of several commits, of code with changes, of several machines, presets or limits, or not finished, or
    if a run failed: an exception, as of a file that is missing, says nothing about a method.
    A task with a measure of its own, as the silhouettes of MESHFIT, has its median and least value where runs ended. A
    task that trains a network has the median and the worst value of its measure, as the decibels of CNN-TEXTURE.

    Args:
        folder: written by `run` or `robustness`.
        name: of the table.
        tasks: only these; all of the folder if not given.
        levels: by how much an error is reduced, as a share of the first one; for tasks that are fitted.
        add: keep the other tasks of a stored table; refused if its commit, machine or protocol is another one.
        failed: keep runs that failed, as runs that did not get there, and print why they failed.
    """
    if not levels or not all(0.0 < one <= LEVELS[-1] for one in levels):
        raise SystemExit(f"levels must be above 0 and at most {LEVELS[-1]:g}, where runs end, got {levels}")
    there = load(folder)
    wanted = chosen("tasks", tasks, list(there.runs)) if tasks else list(there.runs)
    results = _ordered(load(folder, wanted))
    networks = [task for task in wanted if task in NETWORKS]
    if networks and len(networks) < len(wanted):
        raise SystemExit(f"tasks must all be fitted or all train a network, got {', '.join(wanted)}")
    if count := results.unfinished.total():
        raise SystemExit(f"{count} runs in {folder} are unfinished: the same `run` goes on with them")
    _check_failed(results, keep=failed)
    known = read_command(folder)
    whence = result_files.origin(known["commands"], f"results in {folder}") | _protocol(known["settings"], wanted)
    preset = whence["preset"]
    table = trained(results, preset) if networks else fitted(results, levels).merge(measured(results, preset), "left")
    table = table.assign(**whence)
    print(result_files.write(_added(table, name) if add else table, name))
    if left := [task for task in there.runs if task not in wanted]:
        print(f"left out, although the command ran them: {', '.join(left)}")


def _check_failed(results: Results, *, keep: bool) -> None:
    """Print which runs failed, and their exceptions; SystemExit if they are not to be kept."""
    found = Counter(
        f"{method} on {task}: {run.outcome.reason}"
        for task, methods in results.runs.items()
        for method, runs in methods.items()
        for run in runs
        if run.outcome.status == "failed"
    )
    if not found:
        return
    text = "\n".join(
        [f"{found.total()} runs in {results.folder} failed:", *(f"{n} of {one}" for one, n in found.items())]
    )
    if not keep:
        raise SystemExit(
            f"{text}\nDelete RUN.json and RUN.jsonl of these in TASK/METHOD, then the same `run` makes them again; or "
            "give --failed, which keeps them as runs that did not get there"
        )
    print(text)


def _added(table: pd.DataFrame, name: str) -> pd.DataFrame:
    """Return the rows of a stored table that are of other tasks, and then a table; SystemExit if they do not fit."""
    old = result_files.read(name)
    old = old[~old["task"].isin(table["task"])]
    for one in _ALIKE:
        values = dict.fromkeys(result_files.plain(value) for part in (old, table) for value in part[one])
        if len(values) > 1:
            raise SystemExit(f"rows of one table must have one {one}, got {', '.join(one or 'none' for one in values)}")
    return pd.concat([old, table], ignore_index=True)


def _ordered(results: Results) -> Results:
    """Return results with methods in the order of `METHODS`, unknown ones last."""
    place = {name: k for k, name in enumerate(METHODS)}
    runs = {
        task: {name: methods[name] for name in sorted(methods, key=lambda name: place.get(name, len(place)))}
        for task, methods in results.runs.items()
    }
    return replace(results, runs=runs)


def _protocol(settings: dict[str, dict[str, Any]], tasks: Sequence[str]) -> dict[str, Any]:
    """Return the preset, the limit of seconds and the clock that all runs have in common."""
    runs = [one for task in tasks for one in settings.get(task, {}).values()]
    found: dict[str, Any] = {}
    for name, of in (
        ("preset", lambda one: one.get("preset")),
        ("limit", lambda one: one.get("limit")),
        ("clock", _clock),
    ):
        values = {str(of(one)): of(one) for one in runs}
        if len(values) > 1:
            raise SystemExit(f"runs of one table must have one {name}, got {', '.join(sorted(values))}")
        found[name] = next(iter(values.values()), None)
    return found


def _clock(settings: dict[str, Any]) -> str:
    """Return which clock the seconds of a run are of."""
    alone = settings.get("threads", 1) == 1 and settings.get("workers") is None
    return "processor" if alone else "wall"


def fitted(results: Results, levels: Sequence[float] = LEVELS) -> pd.DataFrame:
    """Return a row per task, method, error and level."""
    cells = [((task, method), runs) for task, methods in results.runs.items() for method, runs in methods.items()]
    found = medians(reached(cells, ("task", "method"), levels), ("task", "method", "metric", "level"))
    found["level"] = (100 * found["level"]).round(6)
    about = pd.DataFrame([_about(task, method, runs) for (task, method), runs in cells])
    measures = [f"{one}{end}" for one in ("evaluations", "seconds") for end in ("", "_low", "_high", "_worst")]
    shares = with_intervals(found)
    return about.merge(shares, on=["task", "method"])[[*about, "metric", "level", *measures, *_SHARES]]


def measured(results: Results, preset: Preset) -> pd.DataFrame:
    """Return a row per task and method: the first of the task's own measures where runs ended, its median and least.

    Tasks that need a renderer are left out: none of them has a measure. Without a measure there are no such columns.
    """
    rows = []
    for task in (one for one in results.runs if one in FITTING and one not in RENDERED):
        measures = fitting(task, preset).truth.measures
        if measures is None:
            continue
        for method, runs in results.runs[task].items():
            ends = [measures(torch.tensor(run.outcome.x, dtype=torch.float64)) for run in runs if run.outcome.x]
            name = next(iter(ends[0]), "") if ends else ""
            values = pd.Series([one[name] for one in ends])
            found = {"measure": name, "measure_median": values.median(), "measure_least": values.min()}
            rows.append({"task": task, "method": method} | found)
    return pd.DataFrame(rows, columns=[*(rows[0] if rows else ("task", "method"))])


def trained(results: Results, preset: Preset) -> pd.DataFrame:
    """Return a row per task and method: how far errors of held-out images went down, at the median and at worst.

    And the task's own measure of the parameter error after training, and when this error had gone down, see
    `until_reduced`.

    A run that failed counts in `runs` alone.
    """
    rows = []
    for task, methods in results.runs.items():
        path, about = results.folder / task / HELD_OUT, load_task(task, preset)
        assert isinstance(about, NetworkTask)
        known = pd.read_csv(path) if path.exists() else pd.DataFrame(columns=["method", "run"])
        for method, runs in methods.items():
            ended = [run.outcome.run for run in runs if run.outcome.status != "failed"]
            mine = known[(known["method"] == method) & known["run"].isin(ended)]
            if len(mine) < len(ended) or not ended:
                raise SystemExit(f"{path} has {len(mine)} of {len(ended)} runs of {method}: call the same `run` again")
            (found,) = per_method(mine).to_dict("records")
            errors = found["parameter_after"], mine["parameter_after"].max()
            median, worst = (about.measured(float(one)) for one in errors)
            found |= {"measure": about.measure, "measure_median": median, "measure_worst": worst} | until_reduced(runs)
            rows.append(_about(task, method, runs) | found | {"runs": len(runs), "share": found["reached"] / len(runs)})
    table = with_intervals(pd.DataFrame(rows)).drop(columns=["parameter_before", "parameter_after"])
    return table[[*(name for name in table if name not in _SHARES), *_SHARES]]


_SHARES = ["reached", "runs", "share", "share_low", "share_high"]


def with_intervals(table: pd.DataFrame) -> pd.DataFrame:
    """Return a table with the 95 % interval of every share, by Wilson (1927)."""
    from scipy.stats import binomtest

    pairs = zip(table["reached"], table["runs"], strict=True)
    intervals = [binomtest(int(there), int(runs)).proportion_ci(method="wilson") for there, runs in pairs]
    return table.assign(share_low=[one.low for one in intervals], share_high=[one.high for one in intervals])


def _about(task: str, method: str, runs: Sequence[Run]) -> dict[str, Any]:
    known = METHODS.get(method)
    return {
        "task": task,
        "n": max(len(run.outcome.x) for run in runs) or None,  # a run whose process died has no point
        "method": method,
        "title": known.title if known else "",
        "uses": known.uses if known else "",
        "first_run": min(run.outcome.run for run in runs),
        "evaluation_limit": runs[0].outcome.settings.get("evaluations"),
        "ended_by_time": sum(run.outcome.status == "time limit" for run in runs),
    }
