"""TEXTURE100: TEXTURE with the 10 000 grey values of a 100x100 texture.

The target is the middle 500x500 pixels of the photograph, averaged over blocks of 5x5 pixels.
"""

from experiments.problems.task import Preset, Task
from experiments.problems.tasks.texture import texture

SIDE, BLOCK = 100, 5


def task(preset: Preset = "fast") -> Task:
    return texture("texture100", SIDE, BLOCK)
