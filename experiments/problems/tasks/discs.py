"""DISCS: six discs with hard edges must find their places and radii, from anywhere in the image.

Parameters: x, y and radius of every disc, in units of the image side. Centres are between 0.1 and 0.9, radii between
0.04 and 0.2. The brightness of discs that overlap adds up. Starts: centres uniform in the bounds, radii uniform in
(0.08, 0.14). The image has 64x64 pixels without antialiasing, so that the loss, the mean squared difference of the
images, is constant almost everywhere. The discs are interchangeable: the parameter error is the least over all
assignments of discs to places. The loss has many local minima: two discs may share a place. Sigma: a seventh of the
side.
"""

import torch
from torch import Tensor

from experiments.problems.hard_shapes import discs, fitting
from experiments.problems.task import Preset, Task, assigned_error, uniform

SOLUTION = (
    *(0.22, 0.25, 0.12, 0.5, 0.2, 0.08, 0.78, 0.24, 0.14),
    *(0.25, 0.72, 0.15, 0.55, 0.6, 0.1, 0.8, 0.75, 0.11),
)
"""x, y and radius of each disc."""
BRIGHTNESS = 0.5
"""Of a disc."""
LOWER, UPPER = 6 * (0.1, 0.1, 0.04), 6 * (0.9, 0.9, 0.2)
FIRST, LAST = 6 * (0.1, 0.1, 0.08), 6 * (0.9, 0.9, 0.14)
"""Between these the starts are."""


def task(preset: Preset = "fast") -> Task:
    solution = _vector(SOLUTION)
    places = solution.view(-1, 3)

    def image(x: Tensor) -> Tensor:
        return BRIGHTNESS * discs(x.double())

    return fitting(
        image,
        solution,
        lambda x: assigned_error(x, places),
        name="discs",
        title="places and radii of six interchangeable discs with hard edges",
        parameters="x, y, radius of six discs in units of the image side; centres 0.1 to 0.9, radii 0.04 to 0.2; "
        "starts anywhere, radii U(0.08, 0.14)",
        start=uniform(_vector(FIRST), _vector(LAST)),
        sigma=1 / 7,
        bounds=(_vector(LOWER), _vector(UPPER)),
    )


def _vector(numbers: tuple[float, ...]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)
