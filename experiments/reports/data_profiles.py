"""Data profiles: the share of (problem, target) pairs reached against evaluations (as in More and Wild 2009)."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib as mpl
import numpy as np

from experiments.reports.error_curves import plain_ticks, styles

mpl.use("Agg")
from matplotlib import pyplot as plt


def draw(profiles: Mapping[int, Mapping[str, tuple[Sequence[float], int]]], most: float, path: Path) -> None:
    """Draw a panel for each number of parameters n.

    Args:
        profiles: by n and method, evaluations over n at which pairs were reached, and the number of all pairs.
        most: evaluations over n that a run could use.
        path: of the PNG file.
    """
    chosen = styles(name for methods in profiles.values() for name in methods)
    figure, axes = plt.subplots(
        1, len(profiles), figsize=(4 * len(profiles) + 2, 3.8), sharey=True, squeeze=False, layout="constrained"
    )
    for axis, (n, methods) in zip(axes[0], profiles.items(), strict=True):
        for name, (reached, pairs) in methods.items():
            at = np.sort(np.asarray(reached, dtype=np.float64))
            share = np.arange(1, len(at) + 1) / pairs
            axis.step([*at, most], [*share, share[-1] if len(at) else 0.0], where="post", label=name, **chosen[name])
        axis.set(xscale="log", xlim=(1 / n, most), ylim=(0, 1), xlabel="evaluations / n", title=f"n = {n}")
        plain_ticks(axis)
        axis.grid(alpha=0.3)
    axes[0][0].set_ylabel("share of the targets reached")
    found = [axis.get_legend_handles_labels() for axis in axes[0]]
    legend = {label: handle for handles, labels in found for handle, label in zip(handles, labels, strict=True)}
    figure.legend(legend.values(), legend.keys(), loc="outside right upper", frameon=False)
    figure.savefig(path, dpi=110)
    plt.close(figure)
