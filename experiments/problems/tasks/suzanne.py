"""SUZANNE: an icosphere becomes Suzanne, a mesh of the source, see `tasks.meshfit`."""

from typing import Literal

from experiments.problems.task import Task
from experiments.problems.tasks.meshfit import fitted_to


def task(preset: Literal["fast", "paper"] = "fast") -> Task:
    return fitted_to("suzanne", preset)
