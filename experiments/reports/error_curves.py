"""Error curves of the methods on a task: both errors against run time and against evaluations, on log-log axes."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import numpy.typing as npt
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from experiments.arguments import Folder
from experiments.reports.results import METRICS, Results, Run, load
from experiments.runs.trial import LEVELS

_POINTS = 1000
"""Most corners that a curve is drawn with."""
_LINES = ("-", "--", ":")
_COLORS = 10
_FLOOR = 1e-8
"""Relative errors below are drawn here."""
AXES = {"seconds": "run time [s]", "evaluations": "evaluations"}
Array = npt.NDArray[np.float64]
Style = Mapping[str, Any]


def plot(folder: Folder, /) -> None:
    """Draw both errors of every task against run time and evaluations into DIR, with quartile bands.

    Args:
        folder: written by `run`.
    """
    results = load(folder)
    chosen = styles_of(results)
    for task, methods in results.runs.items():
        path = folder / f"{task}.png"
        curves(task, methods, path, chosen)
        print(path)


def styles(names: Iterable[str]) -> dict[str, Style]:
    """Return colour and dashes by method."""
    return {
        name: {"color": f"C{i % _COLORS}", "linestyle": _LINES[i // _COLORS % len(_LINES)]}
        for i, name in enumerate(dict.fromkeys(names))
    }


def styles_of(results: Results) -> dict[str, Style]:
    """Return colour and dashes by method, the same in the figures of all tasks."""
    return styles(sorted(name for methods in results.runs.values() for name in methods))


def curves(
    task: str,
    methods: Mapping[str, Sequence[Run]],
    path: Path | BinaryIO,
    chosen: Mapping[str, Style] | None = None,
) -> None:
    """Plot the median of the errors, relative to those at the start, and the band between the quartiles."""
    chosen = styles(methods) if chosen is None else chosen
    figure = Figure(figsize=(11, 7), layout="constrained")
    axes = figure.subplots(2, 2, sharex="col", sharey=True)
    for row, metric in zip(axes, METRICS, strict=True):
        for axis, against in zip(row, AXES, strict=True):
            axis.set(xscale="log", yscale="log")
            for name, runs in methods.items():
                band(axis, runs, metric, against, f"{name} ({len(runs)})", chosen[name])
            levels(axis)
        row[0].set_ylabel(f"{metric} error / error at the start")
    for axis, label in zip(axes[1], AXES.values(), strict=True):
        axis.set_xlabel(label)
        plain_ticks(axis)
    handles, labels = axes[0][1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right upper", frameon=False, title="method (runs)")
    figure.suptitle(f"{task}: median and quartiles")
    figure.savefig(path, dpi=110, format="png")


def quartiles(lines: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    """Return the positions [P] where any of the runs changes and the quartiles [3, P] of their errors from there on.

    lines: positions and errors of every run. An error holds until the next row. Before the first row it is the error at
    the start, after the last row the last error. Between two runs quartiles are interpolated on the logarithmic axis
    they are drawn on: on a linear one the larger error alone would count.
    """
    grid = np.unique(np.concatenate([x for x, _ in lines]))
    if len(grid) > _POINTS:
        grid = np.geomspace(grid[0], grid[-1], _POINTS)
    errors = [np.concatenate([[1.0], y])[np.searchsorted(x, grid, side="right")] for x, y in lines]
    return grid, np.exp(np.quantile(np.log(errors), (0.25, 0.5, 0.75), axis=0))


def band(axis: Any, runs: Iterable[Run], metric: str, against: str, label: str, style: Style) -> None:
    lines = [line for run in runs if len((line := _line(run, metric, against))[0])]
    if not lines:
        axis.plot([], [], label=label, **style)
        return
    grid, (low, middle, high) = quartiles(lines)
    axis.step(grid, middle, where="post", label=label, **style)
    axis.fill_between(grid, low, high, step="post", color=style["color"], alpha=0.12, linewidth=0)


def levels(axis: Any) -> None:
    """Draw a grid, and a line at every error that tables count to."""
    for level in LEVELS:
        axis.axhline(1 - level, color="grey", linewidth=0.8, linestyle=":")
    axis.grid(which="major", alpha=0.3)


def plain_ticks(axis: Any) -> None:
    """Label a logarithmic axis with numbers, more of them where it is short, so that they do not overlap."""
    first, last = axis.get_xlim()
    steps = (1.0, 2.0, 5.0) if math.log10(last / first) < 2 else (1.0,)
    axis.xaxis.set_major_locator(LogLocator(subs=steps, numticks=12))
    axis.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axis.xaxis.set_minor_formatter(NullFormatter())


def _line(run: Run, metric: str, against: str) -> tuple[Array, Array]:
    """Return positions above 0 and relative errors there."""
    pairs = [
        (getattr(record, against), error)
        for record, error in zip(run.records, run.error(metric), strict=True)
        if error is not None and getattr(record, against) > 0
    ]
    x, y = np.array(pairs, dtype=np.float64).reshape(-1, 2).T
    return x, np.maximum(y, _FLOOR)
