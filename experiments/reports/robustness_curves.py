"""Error curves of every sweep: a column per sweep, a row per method, a line per value with its quartile band."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.reports import error_curves
from experiments.reports.results import Run

_LINES = ("-", "--", ":", "-.")


def draw(
    task: str, cells: Sequence[tuple[str, str, str, list[Run]]], titles: Mapping[str, str], against: str, path: Path
) -> None:
    """Draw the image error of a task, relative to that at the start, on log-log axes.

    Args:
        task: name.
        cells: method, sweep, value and runs.
        titles: of the sweeps.
        against: "seconds" or "evaluations".
        path: PNG file.
    """
    methods = list(dict.fromkeys(cell[0] for cell in cells))
    sweeps = [sweep for sweep in titles if any(cell[1] == sweep for cell in cells)]
    size = (3.3 * len(sweeps) + 0.4, 2.9 * len(methods) + 0.5)
    figure = Figure(figsize=size, layout="constrained")
    axes = figure.subplots(len(methods), len(sweeps), sharey=True, sharex="row", squeeze=False)
    for line, method in zip(axes, methods, strict=True):
        for axis, sweep in zip(line, sweeps, strict=True):
            values = [(value, runs) for name, one, value, runs in cells if (name, one) == (method, sweep)]
            _axis(axis, values, against)
            axis.set_title(titles[sweep], fontsize=9)
        line[0].set_ylabel(f"{method}\nimage error / at the start", fontsize=9)
    for axis in axes[-1]:
        axis.set_xlabel(error_curves.AXES[against])
    figure.suptitle(f"{task}: median and quartiles")
    figure.savefig(path, dpi=90)


def _axis(axis: Axes, values: Sequence[tuple[str, list[Run]]], against: str) -> None:
    colors = mpl.colormaps["viridis"]
    axis.set(xscale="log", yscale="log")
    for k, (value, runs) in enumerate(values):
        style = {"color": colors(0.9 * k / max(len(values) - 1, 1)), "linestyle": _LINES[k % len(_LINES)]}
        error_curves.band(axis, runs, "image", against, value, style)
    if values:
        error_curves.plain_ticks(axis)
    error_curves.levels(axis)
    if values:
        axis.legend(fontsize=7, frameon=False, loc="lower left")
    else:
        axis.text(0.5, 0.5, "does not apply", ha="center", va="center", transform=axis.transAxes, color="grey")
