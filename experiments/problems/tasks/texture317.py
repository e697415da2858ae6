"""TEXTURE317: TEXTURE with the 100 489 grey values of a 317x317 texture.

The target is the middle 317x317 pixels of the photograph.
"""

from experiments.problems.task import Preset, Task
from experiments.problems.tasks.texture import texture

SIDE, BLOCK = 317, 1


def task(preset: Preset = "fast") -> Task:
    return texture("texture317", SIDE, BLOCK)
