"""CAUSTIC64: CAUSTIC with 64x64 coefficients of the surface, seen on a screen of 128x128 pixels.

A coefficient of 1 is about a quarter as high as in CAUSTIC. A random surface with a standard deviation of 1 then moves
light by about one pixel of 128. The `fast` preset has 256x256 photons, the `paper` preset 512x512.
"""

from experiments.problems.task import Preset, Task
from experiments.problems.tasks.caustic import UNIT, slab

COEFFICIENTS = 64
SIZES = {"fast": (128, 256), "paper": (128, 512)}


def task(preset: Preset = "fast") -> Task:
    return slab("caustic64", preset, COEFFICIENTS, SIZES, 0.25 * UNIT)
