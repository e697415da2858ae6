"""BANANA: an icosphere becomes a banana with colours, a mesh of the source, see `tasks.meshfit`."""

from experiments.problems.task import Preset, Task
from experiments.problems.tasks.meshfit import fitted_to


def task(preset: Preset = "fast") -> Task:
    return fitted_to("banana", preset)
