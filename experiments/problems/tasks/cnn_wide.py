"""CNN with a range of 250 degrees: all angles at which the handle is seen, three times the range of CNN.

Training angles are U(6.5, 19) x 20 degrees, from where the handle comes out behind the mug on one side to where it
disappears on the other; in between, from 40 to 120 degrees, the image does not change. The output is
3.5 + 18.5 sigmoid, the whole circle, so that a network can collapse into the plateau.
"""

from experiments.problems.network_task import NetworkTask
from experiments.problems.task import Preset
from experiments.problems.tasks.cnn import SIZES, Rotation

ANGLES = (6.5, 19.0)
"""Range of the training and held-out angles, in units of 20 degrees."""
OUTPUT = (3.5, 22.0)
"""Range of the predictions, in units of 20 degrees."""


class WideRotation(Rotation):
    """Rotation [K, 1] of the mug in units of 20 degrees."""

    name = "cnn_wide"
    title = "the same from 250 degrees, with a plateau between the ends"
    sigma = (3.0, 0.1)
    angles, output = ANGLES, OUTPUT


def task(preset: Preset = "fast", variant: str = "auto", threads: int | None = None) -> NetworkTask:
    return WideRotation(SIZES[preset], variant, threads)
