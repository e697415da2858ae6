"""What trained encoders predict: held-out images beside the renders of the predictions."""

from collections.abc import Sequence
from pathlib import Path

import torch
from matplotlib.figure import Figure

from experiments.problems.network_task import NetworkTask
from experiments.reports.trained_network import Result


def draw(task: NetworkTask, results: Sequence[Result], path: Path, count: int = 4) -> None:
    """Show held-out inputs, and the renders of the predictions: of the untrained and of every trained encoder."""
    images, parameters = task.held_out
    images, parameters = images[:count], parameters[:count]
    columns = [("input", images, parameters)]
    with torch.no_grad():
        before = results[0].start(images)
        columns.append(("before training", task.image(before), before))
        for result in results:
            after = result.encoder(images)
            columns.append((f"{result.method}\n{result.seconds:.0f} s", task.image(after), after))
    pictures = [task.pictures(renders, x) for _, renders, x in columns]
    rows, wide = len(images), pictures[0].shape[2] / pictures[0].shape[1]
    figure = Figure(figsize=(1.7 * wide * len(columns), 1.85 * rows + 0.5), layout="constrained")
    axes = figure.subplots(rows, len(columns), squeeze=False)
    for column, (title, _, x) in enumerate(columns):
        for row in range(rows):
            axis = axes[row][column]
            axis.imshow(pictures[column][row])
            axis.set(xticks=[], yticks=[])
            axis.set_xlabel(task.caption(x[row]), fontsize=9)
        axes[0][column].set_title(title, fontsize=10)
    figure.savefig(path, dpi=130)
