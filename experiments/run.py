"""`python -m experiments run TASK`: methods on a task, with a log row per iteration, plots, pictures and a table."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import torch
import tyro
from tqdm import tqdm

from experiments import export, figures
from experiments.records import Log, Record, read
from experiments.tables import table
from experiments.tasks.cnn import DEGREES, PRESETS, CnnTask, Preset
from experiments.training import METHODS, Method, Result, train

REDUCTION = 100.0
"""A run succeeds if it divides the held-out parameter error by this."""


def run(
    task: Annotated[Literal["cnn"], tyro.conf.Positional],
    /,
    preset: Literal["fast", "paper"] = "fast",
    methods: str = ",".join(METHODS),
    runs: int = 1,
    seed: int = 0,
    out: Path = Path("results/cnn"),
    variant: str = "auto",
    threads: int | None = None,
) -> None:
    """Train with each method and compare them.

    Args:
        task: cnn trains a network to predict the rotation of a mug from an image, through a path tracer.
        preset: fast has 64x64 images and takes minutes; paper the source's sizes, hours.
        methods: names separated by commas: fr22, our_g, our_h, our_hvp, our_hvpa.
        runs: independent runs of each method, with seeds from `seed` upward.
        seed: of the first run.
        out: folder for logs, figures and the trained encoder; files of the same name are replaced.
        variant: Mitsuba variant; auto takes a just-in-time one only where it is known to work.
        threads: render threads; all cores if not given.
    """
    chosen = parse_methods(methods)
    if runs < 1:
        raise SystemExit(f"runs must be at least 1, got {runs}")
    train_all(PRESETS[preset], chosen, range(seed, seed + runs), out, variant, threads)


def parse_methods(names: str) -> list[Method]:
    """Return methods by their names separated by commas; SystemExit names those that do not exist."""
    found = [name.strip() for name in names.split(",") if name.strip()]
    unknown = [name for name in found if name not in METHODS]
    if unknown or not found:
        raise SystemExit(f"methods must be some of {', '.join(METHODS)}, got {', '.join(unknown) or 'none'}")
    return [METHODS[name] for name in dict.fromkeys(found)]


def train_all(
    preset: Preset, methods: Sequence[Method], seeds: Sequence[int], out: Path, variant: str, threads: int | None
) -> list[Result]:
    """Train every method from every seed; write logs, figures, encoder and table into `out`."""
    torch.set_num_threads(1)  # small tensors: a second thread costs more than it gives
    results: list[Result] = []
    scene = preset.scene(variant, threads)
    print(f"Mitsuba {scene.variant}, {preset.film}x{preset.film} pixels, {preset.spp} samples per pixel", flush=True)
    for seed in seeds:
        task = CnnTask(preset, seed, scene)
        print(f"rendering {preset.images} training and {preset.held_out} held-out images, seed {seed}", flush=True)
        _, _ = task.training, task.held_out
        results += [_one(task, method, out, len(seeds)) for method in methods]
    logs = [list(read(_log(out, result.method, result.run))) for result in results]
    figures.curves(logs, out / "errors.png")
    first = [result for result in results if result.run == seeds[0]]
    figures.predictions(task, first, out / "predictions.png")
    print("\n" + summary(results))
    print(f"\nerrors against run time: {out / 'errors.png'}\npredictions: {out / 'predictions.png'}\nlogs: {out}")
    if export.missing():
        print(f"not exported to ONNX: pip install {' '.join(export.missing())}")
    else:
        path = out / f"encoder-{first[-1].method}.onnx"
        difference = export.export(first[-1].encoder, task.held_out[0], path)
        print(f"encoder: {path}, onnxruntime predicts the same to {DEGREES * difference:.1e} degrees")
    return results


def _one(task: CnnTask, method: Method, out: Path, runs: int) -> Result:
    log = Log(_log(out, method.name, task.seed))
    name = method.name if runs == 1 else f"{method.name} {task.seed}"
    with tqdm(total=task.preset.evaluations, unit=" renders", desc=f"{name:>8}", dynamic_ncols=True) as bar:

        def report(record: Record) -> None:
            log(record)
            error = DEGREES * (record.parameter_error or 0.0) ** 0.5
            bar.set_postfix_str(f"error {error:.2f} degrees, sigma {record.sigma:.2f}", refresh=False)
            bar.update(record.evaluations - bar.n)

        try:
            return train(task, method, task.seed, report)
        finally:
            log.close()


def _log(out: Path, method: str, seed: int) -> Path:
    return out / f"{method}-{seed}.jsonl"


def summary(results: Sequence[Result]) -> str:
    """Return a table with a row per method: medians over its runs, and how many succeeded."""
    rows = []
    for name in dict.fromkeys(result.method for result in results):
        mine = [result for result in results if result.method == name]

        def median(values: list[float]) -> float:
            return float(torch.tensor(values, dtype=torch.float64).quantile(0.5))

        before, after = (DEGREES * median([one.parameter_error[k] ** 0.5 for one in mine]) for k in (0, 1))
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
            ]
        )
    headers = [
        "method",
        "seconds",
        "renders",
        "rms error before [deg]",
        "after [deg]",
        "parameter MSE /",
        "image MSE /",
        f"runs beyond {REDUCTION:.0f}x",
    ]
    return table(headers, rows)
