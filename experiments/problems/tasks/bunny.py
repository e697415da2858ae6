"""BUNNY: position and rotation of the Stanford bunny over a wall, on which it casts a shadow.

Parameters: x and z in scene lengths (the bunny is one high) and the rotation about y in units of 100 degrees, each from
-1 to 1. Solution 0; starts 0.25 +- 0.1 away from it in each of them, with random signs. Loss: mean squared difference
of linear images. There is no plateau. Sigma: 0.25, the distance to the solution; 1 in the source.

Direct light is enough: light that the bunny reflects to the wall changes the loss little. The `fast` preset has
48x48 pixels, the `paper` preset the source's 64x64 with four times the samples.
"""

from functools import partial

import torch

from experiments.problems.rendered import Setting, load_scene, rendered
from experiments.problems.scenes.bunny import OVER_WALL, as_mesh, over_wall
from experiments.problems.task import Preset, Task, around

PRESETS = {"fast": Setting((48, 48), 8, 2), "paper": Setting((64, 64), 32, 6)}


def task(preset: Preset = "fast", variant: str = "auto") -> Task:
    moved = as_mesh(OVER_WALL, (0.0, 0.0, 0.0))
    return rendered(
        name="bunny",
        title="position and rotation of the Stanford bunny over a wall",
        parameters="x, z in scene lengths, rotation in units of 100 degrees, all -1 to 1; "
        "starts +-.25 +- .1, solution 0",
        scene=partial(load_scene, over_wall, OVER_WALL, variant),
        moving=partial(load_scene, partial(over_wall, instances=False), moved, variant),
        variant=variant,
        setting=PRESETS[preset],
        needs="direct light",
        solution=torch.zeros(3).double(),
        start=around(3, 0.25, 0.1),
        sigma=0.25,
        bounds=(-torch.ones(3).double(), torch.ones(3).double()),
        evaluations=400,
    )
