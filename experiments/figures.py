"""Figures of training runs: errors against run time, and pictures of what was predicted."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import torch

from experiments.records import Record
from experiments.scenes.mug import to_srgb
from experiments.tasks.cnn import DEGREES, CnnTask
from experiments.training import Result

mpl.use("Agg")
from matplotlib import pyplot as plt

_POINTS = 120


def curves(runs: Sequence[Sequence[Record]], path: Path) -> None:
    """Plot image and parameter error against seconds, a median and a quartile band per method over its runs.

    The image error of a batch is averaged over one twentieth of a run.
    """
    methods = list(dict.fromkeys(run[0].method for run in runs))
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
    for axis, quantity in zip(axes, ("image_error", "parameter_error"), strict=True):
        for method in methods:
            mine = [run for run in runs if run[0].method == method]
            _band(axis, mine, quantity, method)
        axis.set(xscale="log", yscale="log", xlabel="run time [s]")
        axis.grid(which="major", alpha=0.3)
    axes[0].set_ylabel("image error of new images (MSE)")
    axes[1].set_ylabel("held-out parameter error (MSE, [20°]²)")
    axes[1].legend(frameon=False)
    figure.savefig(path, dpi=130)
    plt.close(figure)


def _band(axis: Any, runs: Sequence[Sequence[Record]], quantity: str, label: str) -> None:
    end = min(run[-1].seconds for run in runs)
    start = max(run[0].seconds for run in runs)
    grid = np.geomspace(max(start, end / 300), end, _POINTS)
    lines = []
    for run in runs:
        seconds = np.array([record.seconds for record in run])
        values = np.array([getattr(record, quantity) for record in run])
        if quantity == "image_error":
            width = max(1, len(run) // 20)
            padded = np.concatenate([np.full(width - 1, values[0]), values])
            values = np.convolve(padded, np.ones(width) / width, mode="valid")
        lines.append(np.interp(grid, seconds, values))
    low, middle, high = np.quantile(lines, (0.25, 0.5, 0.75), axis=0)
    (line,) = axis.plot(grid, middle, label=f"{label} ({len(runs)} runs)" if len(runs) > 1 else label)
    axis.fill_between(grid, low, high, color=line.get_color(), alpha=0.2, linewidth=0)


def predictions(task: CnnTask, results: Sequence[Result], path: Path, count: int = 4) -> None:
    """Show held-out inputs, the render of the untrained prediction and of that of every trained encoder."""
    images, rotation = task.held_out
    images, rotation = images[:count], rotation[:count]
    columns = [("input", images, rotation)]
    with torch.no_grad():
        before = results[0].start(images)
        columns.append(("before training", task.render(before), before))
        for result in results:
            after = result.encoder(images)
            columns.append((f"{result.method}\n{result.seconds:.0f} s", task.render(after), after))
    rows = len(images)
    figure, axes = plt.subplots(
        rows, len(columns), figsize=(1.7 * len(columns), 1.85 * rows + 0.5), layout="constrained", squeeze=False
    )
    for column, (title, pictures, angles) in enumerate(columns):
        for row in range(rows):
            axis = axes[row][column]
            axis.imshow(to_srgb(pictures[row].permute(1, 2, 0).numpy()))
            axis.set(xticks=[], yticks=[])
            axis.set_xlabel(f"{DEGREES * float(angles[row]):.1f}°", fontsize=9)
        axes[0][column].set_title(title, fontsize=10)
    figure.savefig(path, dpi=130)
    plt.close(figure)
