"""HEXAGON: the six corners of a polygon with hard edges, from a smaller hexagon elsewhere.

Parameters: x and y of every corner, in units of the image side, between 0 and 1. The solution is a regular hexagon of
radius 0.32 around (0.55, 0.5). Starts are hexagons of radius 0.15 around (0.4, 0.5), each coordinate uniform within
+-0.06. The image has 64x64 pixels without antialiasing, so that the loss, the mean squared difference of the images, is
constant almost everywhere. The corners may be counted from any of them, and in either direction: the parameter error is
the least over these orders. Sigma: a tenth of the side.
"""

import math

import torch
from torch import Tensor

from experiments.problems.hard_shapes import fitting, polygon
from experiments.problems.task import Preset, Task, uniform

CORNERS = 6
SPREAD = 0.06
"""Of the coordinates of a start."""


def task(preset: Preset = "fast") -> Task:
    solution, first = _regular(0.55, 0.5, 0.32), _regular(0.4, 0.5, 0.15)
    places = solution.view(CORNERS, 2)
    orders = torch.stack([one.roll(k, 0) for one in (places, places.flip(0)) for k in range(CORNERS)]).flatten(1)

    return fitting(
        lambda x: polygon(x.double()),
        solution,
        lambda x: float((orders - x).square().mean(1).min()),
        name="hexagon",
        title="the corners of a hexagon with hard edges",
        parameters="x, y of six corners in units of the image side, 0 to 1; starts: half as large, elsewhere, +- .06",
        start=uniform(first - SPREAD, first + SPREAD),
        sigma=0.1,
        bounds=(torch.zeros_like(solution), torch.ones_like(solution)),
    )


def _regular(x: float, y: float, radius: float) -> Tensor:
    """Return the corners of a regular hexagon, [12]."""
    angle = (torch.arange(CORNERS, dtype=torch.float64) + 0.3) * (2 * math.pi / CORNERS)
    return torch.stack([x + radius * angle.cos(), y + radius * angle.sin()], 1).flatten()
