"""BOX2: a soft square must move to its place in an image, from where the two do not overlap.

Parameters: x and y of the centre, in units of the image side. The square has half width 0.1 and is kept inside the
image, so the bounds are 0.1 and 0.9. Target (0.3, 0.3); starts uniform in (0.43, 0.72)^2, most of them on the plateau
where the square and its target do not overlap. Loss: mean squared difference of the images (`SoftSquares`). Sigma: a
fifth of the side.

One channel is enough, as the square is grey. The `fast` preset has 128x128 pixels, enough for the edge of the square
to be smooth; the `paper` preset the source's 500x500.
"""

from collections.abc import Callable

import torch
from torch import Tensor

from experiments.problems.soft_squares import HALF_WIDTH, BoxTask, box2
from experiments.problems.task import Picture, Preset, Task, Truth, differences_from, least_squares, uniform


def task(preset: Preset = "fast") -> Task:
    side = {"fast": 128, "paper": 500}[preset]
    box = box2(side)
    return fitting(
        box,
        title="the place of a soft square, from a plateau",
        parameters="x, y of the centre in units of the image side, 0.1 to 0.9; "
        "starts U(0.43, 0.72)^2, solution (0.3, 0.3)",
        evaluations=20_000,
        parameter_error=lambda x: float((x - box.loss.target).square().mean()),
    )


def fitting(
    box: BoxTask, *, title: str, parameters: str, evaluations: int, parameter_error: Callable[[Tensor], float]
) -> Task:
    """Return the task of moving the squares of `box` to their places; for BOX2 and BOX10."""
    squares = box.loss
    reference = squares.image(squares.target[None])[0]

    return Task(
        name=box.name.lower(),
        title=title,
        parameters=parameters,
        needs=f"one channel, {squares.side}x{squares.side} pixels",
        n=len(box.start),
        loss=squares,
        start=uniform(box.start - box.half_range, box.start + box.half_range),
        sigma=box.sigma,
        evaluations=evaluations,
        truth=Truth(lambda x: float(squares(x[None])[0]), parameter_error),
        bounds=(torch.full_like(box.start, HALF_WIDTH), torch.full_like(box.start, 1 - HALF_WIDTH)),
        output=least_squares(squares.image, differences_from(reference)),
        picture=Picture(lambda x: squares.image(x[None])[0], lambda: reference),
    )
