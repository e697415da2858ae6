"""Runs of training tasks: logs that resume, errors and predictions as pictures, the network as ONNX, a table."""

import io
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch
from tqdm import tqdm

from experiments.ensembles.provenance import register
from experiments.methods.training import Method, Result, train, trained
from experiments.problems.training_task import Preset, TrainingTask
from experiments.reports import error_curves, onnx_export, predictions
from experiments.reports.results import load
from experiments.reports.tables import table
from experiments.runs.journal import DivergedError
from experiments.runs.recorder import Recorder
from experiments.runs.records import Files, Outcome, Record, read_outcome, write, write_outcome
from experiments.runs.trial import ending

REDUCTION = 100.0
"""A run succeeds if it divides the held-out parameter error by this."""


def train_all(
    kind: type[TrainingTask],
    preset: Preset,
    methods: Sequence[Method],
    seeds: Sequence[int],
    out: Path,
    variant: str,
    threads: int | None,
) -> list[Result]:
    """Train every method from every seed, without those that `out` already has, and write what came of it to `out`.

    Runs that fail are named, and left out of the results.
    """
    torch.set_num_threads(1)  # small tensors: a second thread costs more than it gives
    folder = out / kind.name
    results: list[Result] = []
    scene = preset.scene(variant, threads)
    shared = {"preset": asdict(preset), "variant": scene.variant, "threads": threads}
    register(out, {kind.name: {method.name: {**shared, "method": _settings(kind, method)} for method in methods}})
    size = f"{preset.film}x{preset.film} pixels, {preset.spp} samples per pixel"
    print(f"{kind.name}: Mitsuba {scene.variant}, {size}", flush=True)
    for seed in seeds:
        task = kind(preset, seed, scene)
        if not all(Files(folder / method.name, seed).outcome.exists() for method in methods):
            print(f"rendering {preset.images} training and {preset.held_out} held-out images, seed {seed}", flush=True)
            _, _ = task.training, task.held_out
        for method in methods:
            result = _one(task, method, Files(folder / method.name, seed), len(seeds))
            results += [result] if result else []
    if not results:
        raise SystemExit(f"no run of {kind.name} succeeded")
    _conclude(task, results, out)
    return results


def _settings(kind: type[TrainingTask], method: Method) -> dict[str, Any]:
    return asdict(kind.pooled if method.optimizer == "pooled" else method) | {"sigma": kind.sigma}


def _conclude(task: TrainingTask, results: Sequence[Result], out: Path) -> None:
    """Write figures and encoder, print the table."""
    folder = out / task.name
    shown = {result.method for result in results}
    runs = {name: mine for name, mine in load(out).runs[task.name].items() if name in shown}
    error_curves.curves(task.name, runs, folder / "errors.png")
    first = [result for result in results if result.run == results[0].run]
    predictions.draw(task, first, folder / "predictions.png")
    print("\n" + summary(type(task), results))
    print(f"\nerrors: {folder / 'errors.png'}\npredictions: {folder / 'predictions.png'}\nlogs: {folder}")
    if onnx_export.missing():
        print(f"not exported to ONNX: pip install {' '.join(onnx_export.missing())}")
    else:
        path = folder / f"encoder-{first[-1].method}.onnx"
        difference = onnx_export.export(first[-1].encoder, task.held_out[0], path)
        print(f"encoder: {path}, onnxruntime predicts the same parameters to {difference:.1e}")


def _one(task: TrainingTask, method: Method, files: Files, runs: int) -> Result | None:
    """Train once, or take the result that is there; None if the method failed."""
    weights = files.folder / f"{files.run}.pt"
    if not files.outcome.exists():
        _train(task, method, files, weights, method.name if runs == 1 else f"{method.name} {files.run}")
    outcome = read_outcome(files.outcome)
    if outcome.status == "failed":
        print(f"{method.name} {files.run} failed: {outcome.reason}")
        return None
    return trained(task, outcome, weights)


def _train(task: TrainingTask, method: Method, files: Files, weights: Path, name: str) -> None:
    with tqdm(total=task.preset.evaluations, unit=" renders", desc=f"{name:>8}", dynamic_ncols=True) as bar:

        def watch(record: Record) -> None:
            if record.parameter_error:
                bar.set_postfix_str(f"{task.measure} {task.measured(record.parameter_error):.2f}", refresh=False)
            bar.update(record.evaluations - bar.n)

        recorder = Recorder(task.name, method.name, files.run, files, watch)
        diverged = None

        def solve() -> None:
            nonlocal diverged
            try:
                encoder = train(task, method, files.run, recorder)
            except DivergedError as error:
                diverged = error
                raise
            content = io.BytesIO()
            torch.save(encoder.state_dict(), content)
            write(weights, content.getvalue())

        try:
            end = ending(solve)
        finally:
            recorder.close(ended=diverged is not None)
    if diverged:
        files.log.unlink()
        return _train(task, method, files, weights, name)
    outcome = Outcome(
        task.name,
        method.name,
        files.run,
        end.status,
        "all evaluations used" if end.status == "stopped" else end.reason,
        recorder.seconds,
        recorder.black_box_seconds,
        recorder.evaluations,
        len(recorder.rows) - 1,
        [],
        _settings(type(task), method),
        end.traceback,
    )
    write_outcome(outcome, files)
    return None


def summary(kind: type[TrainingTask], results: Sequence[Result]) -> str:
    """Return a table with a row per method: medians over its runs, and how many succeeded."""
    rows = []
    for name in dict.fromkeys(result.method for result in results):
        mine = [result for result in results if result.method == name]

        def median(values: list[float]) -> float:
            return float(torch.tensor(values, dtype=torch.float64).quantile(0.5))

        before, after = (median([kind.measured(one.parameter_error[k]) for one in mine]) for k in (0, 1))
        share = sum(one.parameter_error[0] >= REDUCTION * one.parameter_error[1] for one in mine)
        rows.append(
            [
                name,
                median([one.seconds for one in mine]),
                median([float(one.evaluations) for one in mine]),
                before,
                after,
                median([one.parameter_error[0] / one.parameter_error[1] for one in mine]),
                median([one.image_error[0] / one.image_error[1] for one in mine]),
                f"{share}/{len(mine)}",
                f"{sum(one.image_error[0] >= 10.0 * one.image_error[1] for one in mine)}/{len(mine)}",
            ]
        )
    headers = [
        "method",
        "seconds",
        "renders",
        f"{kind.measure} before",
        "after",
        "parameter MSE /",
        "image MSE /",
        f"runs beyond {REDUCTION:.0f}x",
        "image error -90 %",
    ]
    return table(headers, rows)
