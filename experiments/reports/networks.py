"""What came of the runs on a network task: errors and predictions as pictures, a network as ONNX, a table."""

import statistics
from collections.abc import Sequence
from pathlib import Path

import torch

from experiments.problems.network_task import NetworkTask
from experiments.reports import export, figures, predictions
from experiments.reports.result import Result
from experiments.reports.results import load
from experiments.reports.tables import table
from experiments.runs.records import Files, Outcome

REDUCTION = 100.0
"""A run succeeds if it divides the held-out parameter error by this."""


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
    results = [_trained(task, one, Files(folder / one.method, one.run).weights) for one in ended]
    shown = {result.method for result in results}
    runs = {name: mine for name, mine in load(out).runs[task.name].items() if name in shown}
    figures.curves(task.name, runs, folder / "errors.png")
    first = [result for result in results if result.run == results[0].run]
    predictions.draw(task, first, folder / "predictions.png")
    print("\n" + summary(task, results))
    print(f"\nerrors: {folder / 'errors.png'}\npredictions: {folder / 'predictions.png'}\nlogs: {folder}")
    if export.missing():
        print(f"not exported to ONNX: pip install {' '.join(export.missing())}")
    else:
        path = folder / f"encoder-{first[-1].method}.onnx"
        difference = export.export(first[-1].encoder, task.held_out[0], path)
        print(f"encoder: {path}, onnxruntime predicts the same parameters to {difference:.1e}")
    return results


def _trained(task: NetworkTask, outcome: Outcome, weights: Path) -> Result:
    """Return the result of a run that has ended, from its outcome and the weights of its encoder."""
    encoder, start = task.encoders(outcome.run)
    encoder.load_state_dict(torch.load(weights, weights_only=True))
    # Of the held-out images, each before and after training.
    image, parameter = ((error(start), error(encoder)) for error in (task.image_error, task.parameter_error))
    return Result(outcome.method, outcome.run, encoder, start, outcome.seconds, outcome.evaluations, image, parameter)


def summary(task: NetworkTask, results: Sequence[Result]) -> str:
    """Return a table with a row per method: medians over its runs, and how many succeeded."""
    rows: list[list[object]] = []
    for name in dict.fromkeys(result.method for result in results):
        mine = [result for result in results if result.method == name]
        parameter, image = ([pair[0] / pair[1] for pair in pairs] for pairs in _errors(mine))
        rows.append(
            [
                name,
                statistics.median(one.seconds for one in mine),
                statistics.median(float(one.evaluations) for one in mine),
                *(statistics.median(task.measured(one.parameter_error[k]) for one in mine) for k in (0, 1)),
                statistics.median(parameter),
                statistics.median(image),
                f"{sum(one >= REDUCTION for one in parameter)}/{len(mine)}",
                f"{sum(one >= 10.0 for one in image)}/{len(mine)}",
            ]
        )
    headers = [
        "method",
        "seconds",
        "renders",
        f"{task.measure} before",
        "after",
        "parameter error divided by",
        "image error divided by",
        f"runs beyond {REDUCTION:.0f}x",
        "image error -90 %",
    ]
    return table(headers, rows)


def _errors(results: Sequence[Result]) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """Parameter and image errors before and after."""
    return [one.parameter_error for one in results], [one.image_error for one in results]
