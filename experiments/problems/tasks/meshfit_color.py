"""MESHFIT_COLOR: MESHFIT with the colours of the vertices as further parameters, see `tasks.meshfit`."""

from typing import Literal

from experiments.problems.task import Task
from experiments.problems.tasks.meshfit import fitted_to


def task(preset: Literal["fast", "paper"] = "fast") -> Task:
    return fitted_to("meshfit_color", preset)
