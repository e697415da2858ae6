"""POSTER: the 1024 grey values of a 32x32 texture, from a render of it at a slant.

Parameters: the texels, row by row from below, between 0 and 1. The solution is the photograph `skimage.data.camera`,
averaged over blocks of 16x16 pixels. Starts: every texel uniform in (0, 1). Loss: mean squared difference of linear
images. Texels are looked up bilinearly: a pixel sees several texels, and several pixels see a texel. Sigma: 0.3, of the
order of the difference of a texel to its solution.

One light and direct light are enough, since the poster reflects no light onto itself. The film is 96 pixels wide, so
that the texels at the far side are as wide as a pixel.
"""

from functools import partial

import torch
from skimage import data

from experiments.problems.rendered import Setting, load_scene, rendered
from experiments.problems.scenes.poster import SIDE, TEXTURE, poster
from experiments.problems.task import Preset, Task, uniform

PRESETS = {"fast": Setting((96, 96), 4, 2), "paper": Setting((192, 192), 32, 2)}


def task(preset: Preset = "fast", variant: str = "auto") -> Task:
    scene = partial(load_scene, poster, TEXTURE, variant)
    photograph = torch.tensor(data.camera() / 255.0).unflatten(0, (SIDE, -1)).unflatten(2, (SIDE, -1)).mean((1, 3))
    lowest, highest = torch.zeros(SIDE**2).double(), torch.ones(SIDE**2).double()
    return rendered(
        name="poster",
        title="the texture of a poster that is seen at a slant",
        parameters="1024 grey values, 0 to 1; starts U(0, 1)",
        scene=scene,
        moving=scene,
        variant=variant,
        setting=PRESETS[preset],
        needs="one light, direct light",
        solution=photograph.flip(0).flatten(),
        start=uniform(lowest, highest),
        sigma=0.3,
        bounds=(lowest, highest),
        evaluations=20_000,
    )
