"""MESHFIT_COLOR: MESHFIT with the colours of the vertices as further parameters, see `tasks.meshfit`."""

from experiments.problems.task import Preset, Task
from experiments.problems.tasks.meshfit import fitted_to


def task(preset: Preset = "fast") -> Task:
    return fitted_to("meshfit_color", preset)
