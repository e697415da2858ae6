"""MUG: the rotation of a coffee mug about its vertical axis, with a plateau where the handle is hidden.

Parameter: the rotation in units of 20 degrees, -4 to 14, one turn. Solution 0, starts U(9, 10): 180 to 200 degrees. The
parameter error counts whole turns as nothing. Loss: mean squared difference of linear images; plateau from 40 to 100
degrees, a small bump at 20, a narrow basin. Sigma: 3, as in the source.

Direct light is enough: with longer paths the loss has the same minimum and plateau, and twice the noise. The `fast`
preset has a quarter of the source's film and samples, the `paper` preset all of it.
"""

from functools import partial

import torch
from torch import Tensor

from experiments.problems.rendered import Setting, rendered
from experiments.problems.scenes.mug import DEGREES, MESH_ROTATION, ROTATION, mug_scene
from experiments.problems.task import Preset, Task, uniform
from torch_zerohess.adapters.mitsuba import MitsubaScene

TURN = 360.0 / DEGREES
PRESETS = {"fast": Setting((64, 48), 8, 2), "paper": Setting((256, 192), 32, 6)}


def parameter_error(x: Tensor) -> float:
    """Squared distance to the nearest whole turn."""
    return float((torch.remainder(x + TURN / 2, TURN) - TURN / 2).square().mean())


def task(preset: Preset = "fast", variant: str = "auto") -> Task:
    def scene(setting: Setting, *, instances: bool = True) -> MitsubaScene:
        rotation = ROTATION if instances else MESH_ROTATION
        return mug_scene(
            (rotation,),
            film=setting.film,
            spp=setting.spp,
            depth=setting.depth,
            instances=instances,
            variant=variant,
            threads=1,
        )

    return rendered(
        name="mug",
        title="the rotation of a mug whose handle is hidden on the way",
        parameters="rotation in units of 20 degrees, -4 to 14; starts U(9, 10), solution 0",
        scene=scene,
        moving=partial(scene, instances=False),
        variant=variant,
        setting=PRESETS[preset],
        needs="direct light",
        solution=torch.zeros(1).double(),
        start=uniform(torch.tensor([9.0]).double(), torch.tensor([10.0]).double()),
        sigma=3.0,
        bounds=(torch.tensor([-4.0]).double(), torch.tensor([14.0]).double()),
        evaluations=400,
        parameter_error=parameter_error,
    )
