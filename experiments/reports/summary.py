"""Tables of an ensemble: evaluations and seconds until an error is reduced by 90, 99 and 99.9 %.

A run that failed, stopped or ran out of time before it got there has not got there: it counts in `runs`, not in
`share`. Medians are over the runs that got there, and there is none if these are fewer than half.
"""

import json
import statistics
from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from dataclasses import asdict, dataclass, fields, replace
from typing import Literal

import pandas as pd

from experiments.arguments import Folder
from experiments.problems.catalogue import chosen
from experiments.reports import source_table
from experiments.reports.medians import MEASURES, medians, objects, reached
from experiments.reports.results import METRICS, Results, Run, load
from experiments.reports.speed_ups import HEADERS, SpeedUp, speed_ups, with_ratios
from experiments.reports.tables import table as text_table
from experiments.runs.trial import LEVELS

REFERENCES = ("gaussian_process", "descent", "our_hvpa", "our_hvp", "our_h", "our_g")
"""Ratios are to the first of these that a folder has runs of."""


@dataclass(frozen=True)
class Row:
    """Medians of one method on one task until one error is reduced by `level`."""

    task: str
    method: str
    metric: str
    level: float
    seconds: float | None
    evaluations: float | None
    share: float
    """Of the runs that got there."""
    runs: int
    ratio_seconds: float | None = None
    """To the reference method."""
    ratio_evaluations: float | None = None


@dataclass(frozen=True)
class Overhead:
    """Median seconds per iteration outside of the black box, and per evaluation inside of it."""

    task: str
    method: str
    overhead: float | None
    black_box: float | None


@dataclass(frozen=True)
class Failure:
    """Runs that ended for the same reason, before they had reached the goal of the task."""

    task: str
    method: str
    status: str
    reason: str
    runs: int


@dataclass(frozen=True)
class Summary:
    """Everything that the tables of a folder say."""

    reference: str | None
    rows: list[Row]
    speed_ups: list[SpeedUp]
    mean_speed_up: SpeedUp
    """Over all methods but the reference."""
    overheads: list[Overhead]
    failures: list[Failure]
    unfinished: int
    """Runs that have not ended, which no number includes."""


def summarize(results: Results, reference: str | None = None, methods: Collection[str] | None = None) -> Summary:
    """Return the tables, with ratios to a method, by default the first of `REFERENCES`; of some methods, or of all."""
    if methods is not None:
        results = _of_methods(results, methods)
    there = {method for runs in results.runs.values() for method in runs}
    reference = reference or next((name for name in REFERENCES if name in there), None)
    cells = [((task, name), runs) for task, methods in results.runs.items() for name, runs in methods.items()]
    found = medians(reached(cells, ("task", "method")), ("task", "metric", "level", "method"))
    ratios = with_ratios(found, reference)
    *speed, mean = speed_ups(ratios, reference)
    return Summary(
        reference,
        [Row(**one) for one in objects(ratios[[field.name for field in fields(Row)]])],
        speed,
        mean,
        [_overhead(*cell, runs) for cell, runs in cells],
        [failure for cell, runs in cells for failure in _failures(*cell, runs)],
        results.unfinished.total(),
    )


def _of_methods(results: Results, methods: Collection[str]) -> Results:
    """Return the runs of some methods, without tasks that have none."""
    runs = {task: {name: mine[name] for name in mine if name in methods} for task, mine in results.runs.items()}
    unfinished = Counter({name: count for name, count in results.unfinished.items() if name in methods})
    return replace(results, runs={task: mine for task, mine in runs.items() if mine}, unfinished=unfinished)


def _overhead(task: str, method: str, runs: Sequence[Run]) -> Overhead:
    overhead = [run.outcome.overhead for run in runs if run.outcome.overhead is not None]
    inside = [run.outcome.black_box_seconds / run.outcome.evaluations for run in runs if run.outcome.evaluations]
    return Overhead(
        task,
        method,
        statistics.median(overhead) if overhead else None,
        statistics.median(inside) if inside else None,
    )


def _failures(task: str, method: str, runs: Sequence[Run]) -> Iterator[Failure]:
    ends = Counter((run.outcome.status, run.outcome.reason) for run in runs if run.outcome.status != "finished")
    for (status, reason), count in ends.items():
        yield Failure(task, method, status, reason, count)


def as_json(summary: Summary) -> str:
    return json.dumps(asdict(summary), indent=1)


def as_csv(summary: Summary) -> str:
    text: str = pd.DataFrame(summary.rows).to_csv(index=False, lineterminator="\n")
    return text.rstrip("\n")


def as_table_2(summary: Summary) -> str:
    """Ratios of the source's Table 2 beside ours, for the tasks that both have."""
    rows = pd.DataFrame([asdict(row) for row in summary.rows]).astype(dict.fromkeys(MEASURES, float))
    rows["level"] = (100 * rows["level"]).round(6)
    found = source_table.side_by_side(rows, list(rows["task"].unique()))
    if found.empty:
        raise SystemExit(f"Table 2 of the source has {', '.join(source_table.printed()['task'].unique())}")
    parts = [
        f"{metric} error: ratios to our_hvpa\n" + text_table(source_table.HEADERS, source_table.rows(found, metric))
        for metric in METRICS
    ]
    return "\n\n".join(parts)


def as_text(summary: Summary) -> str:
    """One table per task, then the mean ratios and why runs ended early."""
    parts = []
    for task in dict.fromkeys(row.task for row in summary.rows):
        headers, rows = task_table(summary, task)
        parts.append(f"{task}: median evaluations, seconds and share of the runs until an error is reduced by")
        parts[-1] += f"\n{text_table(headers, rows)}"
    if summary.reference and summary.speed_ups:
        parts.append(f"mean ratio to {summary.reference}, over tasks, errors and levels\n" + _speed_up_text(summary))
    if summary.failures:
        rows = [[f.task, f.method, f.status, f"{f.runs}", f.reason] for f in summary.failures]
        headers = ["task", "method", "", "runs", "reason"]
        parts.append("how runs ended that did not reach their goal\n" + text_table(headers, rows))
    if summary.unfinished:
        parts.append(f"{summary.unfinished} unfinished runs are left out")
    return "\n\n".join(parts)


def task_table(summary: Summary, task: str) -> tuple[list[str], list[list[object]]]:
    """Return headers and rows of the table of one task: a row per method, a cell per error and level."""
    mine = [row for row in summary.rows if row.task == task]
    headers = ["method", *(f"{metric} {100 * level:g} %" for metric in METRICS for level in LEVELS)]
    rows: list[list[object]] = []
    for method in dict.fromkeys(row.method for row in mine):
        cells = {(row.metric, row.level): row for row in mine if row.method == method}
        overhead = next(one.overhead for one in summary.overheads if (one.task, one.method) == (task, method))
        runs = next(iter(cells.values())).runs
        rows.append(
            [
                method,
                *(_cell(cells[metric, level]) for metric in METRICS for level in LEVELS),
                None if overhead is None else 1e3 * overhead,
                runs,
            ]
        )
    return [*headers, "overhead per row [ms]", "runs"], rows


def _cell(row: Row) -> str:
    share = f"{100 * row.share:.0f}%"
    if row.evaluations is None:
        return f"- {share}"
    return f"{row.evaluations:.1f}".removesuffix(".0") + f" {row.seconds:.3g}s {share}"


def _speed_up_text(summary: Summary) -> str:
    return text_table(HEADERS, [list(asdict(one).values()) for one in (*summary.speed_ups, summary.mean_speed_up)])


def table(
    folder: Folder,
    /,
    format: Literal["text", "csv", "json", "table_2"] = "text",
    reference: str | None = None,
    methods: str = "all",
) -> None:
    """Print how many evaluations and seconds every method took, with ratios to the reference and failed runs.

    Args:
        folder: written by `run`.
        format: text prints a table per task; csv and json a row per task, method, error and level; table_2 the ratios
            to our_hvpa beside those that the source prints.
        reference: method that ratios are to; the recommended one, or the best of the source's, if not given.
        methods: names separated by commas, or all.
    """
    results = load(folder)
    there = sorted({method for runs in results.runs.values() for method in runs})
    wanted = there if methods.strip() == "all" else chosen("methods", methods.split(","), there)
    if reference is not None:
        (reference,) = chosen("reference", [reference], wanted)
    summary = summarize(results, reference, wanted)
    if format == "table_2":
        print(as_table_2(summary))
        return
    print({"text": as_text, "csv": as_csv, "json": as_json}[format](summary))
