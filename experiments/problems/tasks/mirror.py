"""MIRROR: position and rotation of the Stanford bunny, seen through two mirrors only.

Parameters: x and y in scene lengths (the bunny is one high) and the rotation about y in units of 100 degrees, each from
-1 to 1. Solution 0; starts 0.25 +- 0.1 away from it in each of them, with random signs. Loss: mean squared difference
of linear images. Sigma: 0.25, the distance to the solution.

Paths need four segments (mirror, mirror, bunny, light). Longer paths, of light that falls on the bunny through a mirror
or from the bunny itself, nearly halve the loss, but hardly change its shape (`python -m experiments full_setting
mirror`). The `fast` preset has 48x48 pixels, the `paper` preset 64x64 with four times the samples.
"""

from functools import partial

import torch

from experiments.problems.rendered import Setting, load_scene, rendered
from experiments.problems.scenes.bunny import IN_MIRRORS, SEEN_AT, as_mesh, in_mirrors
from experiments.problems.task import Preset, Task, around

PRESETS = {"fast": Setting((48, 48), 8, 4), "paper": Setting((64, 64), 32, 6)}


def task(preset: Preset = "fast", variant: str = "auto") -> Task:
    moved = as_mesh(IN_MIRRORS, SEEN_AT)
    return rendered(
        name="mirror",
        title="position and rotation of the Stanford bunny in two mirrors",
        parameters="x, y in scene lengths, rotation in units of 100 degrees, all -1 to 1; "
        "starts +-.25 +- .1, solution 0",
        scene=partial(load_scene, in_mirrors, IN_MIRRORS, variant),
        moving=partial(load_scene, partial(in_mirrors, instances=False), moved, variant),
        variant=variant,
        setting=PRESETS[preset],
        needs="two mirrors and direct light",
        solution=torch.zeros(3).double(),
        start=around(3, 0.25, 0.1),
        sigma=0.25,
        bounds=(-torch.ones(3).double(), torch.ones(3).double()),
        evaluations=400,
    )
