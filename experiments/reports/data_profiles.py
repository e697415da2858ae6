"""Data profiles (More and Wild 2009): the share of problems solved, or of targets reached, against evaluations."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from experiments.reports.error_curves import plain_ticks, styles

_SPAN = 300
"""From the first to the last evaluation that is drawn, as a ratio."""
Profile = tuple[Sequence[float], int]
"""Evaluations, in some unit, after which problems were solved or targets reached, and the number of all."""


def draw(profiles: Mapping[str, Mapping[str, Profile]], of: str, unit: str, most: float, path: Path) -> None:
    """Draw a panel for each title.

    Args:
        profiles: by title and method.
        of: what they are shares of.
        unit: of the evaluations.
        most: evaluations in this unit that a run could use.
        path: of the PNG file.
    """
    chosen = styles(name for methods in profiles.values() for name in methods)
    figure = Figure(figsize=(4 * len(profiles) + 2, 3.8), layout="constrained")
    axes = figure.subplots(1, len(profiles), sharey=True, squeeze=False)
    for axis, (title, methods) in zip(axes[0], profiles.items(), strict=True):
        for name, (reached, pairs) in methods.items():
            at = np.sort(np.asarray(reached, dtype=np.float64))
            share = np.arange(1, len(at) + 1) / pairs
            axis.step([*at, most], [*share, share[-1] if len(at) else 0.0], where="post", label=name, **chosen[name])
        axis.set(xscale="log", xlim=(most / _SPAN, most), ylim=(0, 1), xlabel=f"evaluations / {unit}", title=title)
        plain_ticks(axis)
        axis.grid(alpha=0.3)
    axes[0][0].set_ylabel(f"share of {of}")
    found = [axis.get_legend_handles_labels() for axis in axes[0]]
    legend = {label: handle for handles, labels in found for handle, label in zip(handles, labels, strict=True)}
    figure.legend(legend.values(), legend.keys(), loc="outside right upper", frameon=False)
    figure.savefig(path, dpi=110)
