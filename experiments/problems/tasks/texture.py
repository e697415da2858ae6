"""TEXTURE: the 1024 grey values of a 32x32 texture, the task with many parameters.

Parameters: the pixels, row by row, between 0 and 1. The target is the photograph `skimage.data.camera`, averaged over
blocks of 16x16 pixels. Starts: every pixel uniform in (0, 1). Loss: mean squared difference of the pixels, so that the
image error and the parameter error are the same number. Sigma: 0.3, of the order of the difference of a pixel to its
target.

TEXTURE100 has the middle 500x500 pixels of the photograph, averaged over blocks of 5x5 pixels: 10 000 grey values.
TEXTURE317 has the middle 317x317 pixels themselves: 100 489 grey values.

The render is the texture itself, as nothing else in an image of it would depend on the parameters: no light, camera or
film. Both presets are the same.
"""

import torch
from skimage import data
from torch import Tensor

from experiments.problems.task import Picture, Preset, Task, Truth, differences_from, least_squares, uniform


def task(preset: Preset = "fast") -> Task:
    return _texture("texture", 32, 16)


def texture100(preset: Preset = "fast") -> Task:
    return _texture("texture100", 100, 5)


def texture317(preset: Preset = "fast") -> Task:
    return _texture("texture317", 317, 1)


def _texture(name: str, side: int, block: int) -> Task:
    """Return the task of finding the middle of the photograph, as side x side means over block x block pixels."""
    photograph = torch.tensor(data.camera() / 255.0)
    margin = (len(photograph) - side * block) // 2
    middle = photograph[margin:, margin:][: side * block, : side * block]
    reference = middle.unflatten(0, (side, -1)).unflatten(2, (side, -1)).mean((1, 3))
    target, n = reference.flatten(), side**2

    def loss(x: Tensor) -> Tensor:
        return (x - target).square().mean(1)

    def error(x: Tensor) -> float:
        return float(loss(x[None])[0])

    return Task(
        name=name,
        title=f"the pixels of a {side}x{side} texture",
        parameters=f"{n} grey values, 0 to 1; starts U(0, 1)",
        needs="the texture itself: no light, camera or film",
        n=n,
        loss=loss,
        start=uniform(torch.zeros(n).double(), torch.ones(n).double()),
        sigma=0.3,
        evaluations=100_000,
        bounds=(torch.zeros(n).double(), torch.ones(n).double()),
        output=least_squares(lambda x: x.view(-1, side, side), differences_from(reference)),
        truth=Truth(error, error, analytic=lambda x, sigma: loss(x[None])[0] + sigma**2),
        picture=Picture(lambda x: x.view(side, side).clamp(0, 1), lambda: reference),
    )
