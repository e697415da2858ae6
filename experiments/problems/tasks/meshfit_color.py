"""MESHFIT_COLOR: MESHFIT with the colours of the vertices as further parameters, see `tasks.meshfit`."""

from experiments.problems.tasks.meshfit import color_task as task

__all__ = ["task"]
