"""Error curves of the methods on a task: both errors against run time and against evaluations, on log-log axes."""

from collections.abc import Iterator, Sequence
from itertools import cycle
from pathlib import Path
from typing import Annotated, Any, BinaryIO

import matplotlib as mpl
import numpy as np
import numpy.typing as npt
import tyro

from experiments.results import METRICS, Run, load
from experiments.trial import LEVELS

mpl.use("Agg")
from matplotlib import pyplot as plt

_POINTS = 200
_FLOOR = 1e-8
"""Relative errors below are drawn here."""
_AXES = {"seconds": "run time [s]", "evaluations": "evaluations"}
Array = npt.NDArray[np.float64]


def plot(folder: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="DIR")], /) -> None:
    """Draw both errors of every task against run time and evaluations into DIR, with quartile bands.

    Args:
        folder: written by `run`.
    """
    for task, methods in load(folder).runs.items():
        path = folder / f"{task}.png"
        curves(task, methods, path)
        print(path)


def curves(task: str, methods: dict[str, list[Run]], path: Path | BinaryIO) -> None:
    """Plot the median of the errors, relative to those at the start, and the band between the quartiles."""
    figure, axes = plt.subplots(2, 2, figsize=(11, 7), layout="constrained", sharex="col", sharey=True)
    for row, metric in zip(axes, METRICS, strict=True):
        for axis, against in zip(row, _AXES, strict=True):
            for (name, runs), style in zip(methods.items(), _styles(), strict=False):
                _band(axis, runs, metric, against, f"{name} ({len(runs)})", style)
            for level in LEVELS:
                axis.axhline(1 - level, color="grey", linewidth=0.8, linestyle=":")
            axis.set(xscale="log", yscale="log")
            axis.grid(which="major", alpha=0.3)
        row[0].set_ylabel(f"{metric} error / error at the start")
    for axis, label in zip(axes[1], _AXES.values(), strict=True):
        axis.set_xlabel(label)
    handles, labels = axes[0][1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, title="method (runs)")
    figure.suptitle(f"{task}: median and quartiles")
    figure.savefig(path, dpi=110, format="png")
    plt.close(figure)


def _styles() -> Iterator[dict[str, Any]]:
    return ({"color": f"C{color}", "linestyle": line} for line in cycle(("-", "--", ":")) for color in range(10))


def _band(axis: Any, runs: Sequence[Run], metric: str, against: str, label: str, style: dict[str, Any]) -> None:
    lines = [line for run in runs if len((line := _line(run, metric, against))[0])]
    if not lines:
        axis.plot([], [], label=label, **style)
        return
    grid = np.geomspace(min(x[0] for x, _ in lines), max(x[-1] for x, _ in lines), _POINTS)
    # An error holds until the next row; before the first row it is that of the start, after the last one the last.
    values = [np.concatenate([[1.0], y])[np.searchsorted(x, grid, side="right")] for x, y in lines]
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75), axis=0)
    axis.plot(grid, middle, label=label, **style)
    axis.fill_between(grid, low, high, color=style["color"], alpha=0.12, linewidth=0)


def _line(run: Run, metric: str, against: str) -> tuple[Array, Array]:
    """Return positions above 0 and relative errors there."""
    pairs = [
        (getattr(record, against), error)
        for record, error in zip(run.records, run.error(metric), strict=True)
        if error is not None and getattr(record, against) > 0
    ]
    x, y = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    return x, np.maximum(y, _FLOOR)
