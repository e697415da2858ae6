"""MESHFIT_COLOR: MESHFIT with the colours of the vertices as further parameters, see `experiments.tasks.meshfit`."""

from experiments.tasks.meshfit import color_task as task

__all__ = ["task"]
