"""SHAD: the position of a sphere outside the view, from its shadow on a wall.

Parameters: y and z of the sphere relative to (8.049, -2), in scene lengths, bounds (-3.25, 1) and (0.25, 3.75), within
which the whole shadow is in view: where it leaves, the loss falls. Starts (-0.5, 2.5) +- 0.1, solution (-1.5, 1). Loss:
mean squared difference of linear images. The shadows at start and solution do not overlap: a plateau. Sigma: 0.5 in the
source; here 1, the radius of the shadow in these units and half of the distance.

Direct light is enough: there is one wall, and the sphere is out of view. The `fast` preset has a quarter of the
source's film and samples, the `paper` preset all of it.
"""

from functools import partial

import torch

from experiments.problems.rendered import Setting, load_scene, rendered
from experiments.problems.scenes.shadow import POSITION, shadow
from experiments.problems.task import Preset, Task, uniform

PRESETS = {"fast": Setting((64, 48), 8, 2), "paper": Setting((256, 192), 32, 6)}


def task(preset: Preset = "fast", variant: str = "auto") -> Task:
    start = torch.tensor([-0.5, 2.5]).double()
    return rendered(
        name="shad",
        title="the position of a sphere out of view, from its shadow",
        parameters="y, z of the sphere in scene lengths, (-3.25, 1) and (.25, 3.75); starts (-.5, 2.5) +- .1, "
        "solution (-1.5, 1)",
        scene=partial(load_scene, shadow, POSITION, variant),
        moving=partial(load_scene, partial(shadow, instances=False), POSITION, variant),
        variant=variant,
        setting=PRESETS[preset],
        needs="direct light",
        solution=torch.tensor([-1.5, 1.0]).double(),
        start=uniform(start - 0.1, start + 0.1),
        sigma=1.0,
        bounds=(torch.tensor([-3.25, 0.25]).double(), torch.tensor([1.0, 3.75]).double()),
        evaluations=400,
    )
