"""What trained encoders predict: held-out images beside the renders of the predictions."""

from collections.abc import Sequence
from pathlib import Path

import matplotlib as mpl
import torch

from experiments.scenes.meshes import to_srgb
from experiments.tasks.cnn import DEGREES, CnnTask
from experiments.training import Result

mpl.use("Agg")
from matplotlib import pyplot as plt


def draw(task: CnnTask, results: Sequence[Result], path: Path, count: int = 4) -> None:
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
