"""CNN with a range of 250 degrees: all angles at which the handle is seen, three times the range of CNN.

Training angles are U(6.5, 19) x 20 degrees, from where the handle comes out behind the mug on one side to where it
disappears on the other; in between, from 40 to 120 degrees, the image does not change. The output is
3.5 + 18.5 sigmoid, the whole circle, so that a network can collapse into the plateau.
"""

from dataclasses import dataclass

from experiments.methods.pooled import Pooled
from experiments.problems.tasks.cnn import CnnPreset, CnnTask

ANGLES = (6.5, 19.0)
"""Range of the training and held-out angles, in units of 20 degrees."""
OUTPUT = (3.5, 22.0)
"""Range of the predictions, in units of 20 degrees."""


@dataclass(frozen=True)
class WidePreset(CnnPreset):
    """Size of the task, its network and scene."""

    output = OUTPUT


class Task(CnnTask):
    """Rotation [K, 1] of the mug in units of 20 degrees."""

    name = "cnn_wide"
    sigma = (3.0, 0.1)
    pooled = Pooled(temperature=0.1, steps=1500, rank=64)
    angles = ANGLES


PRESETS = {
    "fast": WidePreset(64, 8, 2, (2, 2, 2), evaluations=4000, images=1024, held_out=32),
    "paper": WidePreset(256, 32, 6, (2, 4, 4), evaluations=12000, images=4096, held_out=64),
}
