"""What came of the runs on a network task: errors and predictions as pictures, a network as ONNX, a table."""

from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from experiments.problems.network_task import NetworkTask
from experiments.reports import error_curves, onnx_export, predictions
from experiments.reports.medians import MEASURES, medians, reached
from experiments.reports.results import METRICS, Run, load
from experiments.reports.tables import table
from experiments.reports.trained_network import Result, encoders_of
from experiments.runs.records import Outcome, write

REDUCTION = 100.0
"""A run succeeds if it divides the held-out parameter error by this."""
HELD_OUT = "held_out.csv"
"""In the folder of a task: errors of the held-out images, a row per run."""


def conclude(task: NetworkTask, outcomes: Sequence[Outcome], out: Path) -> list[Result]:
    """Write figures and encoder of the outcomes on a task, print the table and return what it is made of.

    Runs that have failed are named and left out. SystemExit if all have.

    Args:
        task: of the outcomes.
        outcomes: at least one.
        out: folder of the ensemble.
    """
    folder = out / task.name
    for one in outcomes:
        if one.status == "failed":
            print(f"{task.name} {one.method} {one.run} failed: {one.reason}")
    ended = [one for one in outcomes if one.status != "failed"]
    if not ended:
        raise SystemExit(f"no run of {task.name} succeeded")
    print(f"\n{task.name}: {task.size}; rendering what the networks predict", flush=True)
    task.prepare(ended[0].run)
    results = [_trained(task, one, out) for one in ended]
    _remember(held_out(task.name, results), folder / HELD_OUT)
    shown = {result.method for result in results}
    runs = {name: mine for name, mine in load(out, {task.name}).runs[task.name].items() if name in shown}
    error_curves.curves(task.name, runs, folder / "errors.png")
    first = [result for result in results if result.run == results[0].run]
    predictions.draw(task, first, folder / "predictions.png")
    print("\n" + summary(task, results))
    print(f"\nerrors: {folder / 'errors.png'}\npredictions: {folder / 'predictions.png'}\nlogs: {folder}")
    if onnx_export.missing():
        print(f"not exported to ONNX: pip install {' '.join(onnx_export.missing())}")
    else:
        path = folder / f"encoder-{first[-1].method}.onnx"
        difference = onnx_export.export(first[-1].encoder, task.held_out[0], path)
        print(f"encoder: {path}, onnxruntime predicts the same parameters to {difference:.1e}")
    return results


def _trained(task: NetworkTask, outcome: Outcome, out: Path) -> Result:
    """Return the result of a run that has ended."""
    encoder, start = encoders_of(task, outcome, out)
    # Of the held-out images, each before and after training.
    image, parameter = ((error(start), error(encoder)) for error in (task.image_error, task.parameter_error))
    return Result(outcome.method, outcome.run, encoder, start, outcome.seconds, outcome.evaluations, image, parameter)


def held_out(task: str, results: Sequence[Result]) -> pd.DataFrame:
    """Return a row per run: renders, seconds, and the errors of held-out images before and after training."""
    columns = ["task", "method", "run", "renders", "seconds"]
    columns += [f"{metric}_{when}" for metric in METRICS for when in ("before", "after")]
    rows = [
        (task, one.method, one.run, one.evaluations, one.seconds, *one.image_error, *one.parameter_error)
        for one in results
    ]
    return pd.DataFrame(rows, columns=columns)


def per_method(rows: pd.DataFrame) -> pd.DataFrame:
    """Return a row per task and method of `held_out`: medians, errors divided by (also at worst), and successes.

    Quartiles are `seconds_low` and so on.
    """
    for metric in METRICS:
        rows = rows.assign(**{f"{metric}_divided": rows[f"{metric}_before"] / rows[f"{metric}_after"]})
    groups = rows.assign(reached=rows["parameter_divided"] >= REDUCTION).groupby(["task", "method"], sort=False)
    found = groups[["renders", "seconds", "parameter_before", "parameter_after"]].median()
    for metric in reversed(METRICS):
        found[f"{metric}_divided"] = groups[f"{metric}_divided"].median()
        found[f"{metric}_divided_worst"] = groups[f"{metric}_divided"].min()
    for name in ("seconds", *(f"{metric}_divided" for metric in reversed(METRICS))):
        for end, share in (("low", 0.25), ("high", 0.75)):
            found[f"{name}_{end}"] = groups[name].quantile(share)
    return found.assign(reached=groups["reached"].sum(), runs=groups.size()).reset_index()


def until_reduced(runs: Sequence[Run]) -> dict[str, float]:
    """Return when the held-out parameter error of runs of one method was first divided by `REDUCTION`.

    `reduced_evaluations` and `reduced_seconds` are medians, `..._worst` the most, over the runs that got there. They
    are NaN if these are fewer than half. `reduced_share` is the share of the runs that got there. A run may get there
    and end with a larger error.
    """
    found = medians(reached([((), runs)], (), [1.0 - 1.0 / REDUCTION]), ("metric",)).set_index("metric")
    names = [f"{measure}{end}" for measure in MEASURES for end in ("", "_worst")]
    return {f"reduced_{name}": float(found[name]["parameter"]) for name in (*names, "share")}


def summary(task: NetworkTask, results: Sequence[Result]) -> str:
    """Return a table with a row per method: medians over its runs, and how many succeeded."""
    found = per_method(held_out(task.name, results))
    rows = [
        [
            *(one["method"], one["renders"], one["seconds"]),
            *(task.measured(one[f"parameter_{when}"]) for when in ("before", "after")),
            *(one[f"{metric}_divided{worst}"] for metric in reversed(METRICS) for worst in ("", "_worst")),
            f"{one['reached']} of {one['runs']}",
        ]
        for one in found.to_dict("records")
    ]
    headers = ["method", "renders", "seconds", f"{task.measure} before", "after"]
    headers += ["parameter error divided by", "at worst", "image error divided by", "at worst", "runs that succeed"]
    return table(headers, rows)


def _remember(rows: pd.DataFrame, path: Path) -> None:
    """Write the rows of some runs to a file, beside the rows of other runs."""
    if path.exists():
        known = pd.read_csv(path)
        rows = pd.concat([known, rows]).drop_duplicates(["method", "run"], keep="last")
    write(path, rows.to_csv(index=False, lineterminator="\n"))
