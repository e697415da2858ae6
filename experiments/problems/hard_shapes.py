"""Discs and polygons with hard edges: images that are constant almost everywhere in their parameters.

Lengths are in units of the image side. Row is y, column is x, and a pixel is at its centre.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from experiments.problems.task import Picture, Task, Truth, differences_from, least_squares

SIDE = 64
"""Pixels along the image side."""


def discs(points: Tensor) -> Tensor:
    """Return the images [K, side, side] of points [K, 3 c], x, y and radius of every disc: discs over each pixel."""
    x, y, radius = points.view(len(points), -1, 3, 1).unbind(2)
    pixel = _pixels(points)
    across, down = (pixel - x).square(), (pixel - y).square()  # [K, c, side]
    inside = down[..., :, None] + across[..., None, :] < radius.square()[..., None]
    return inside.sum(1).to(points)


def polygon(points: Tensor) -> Tensor:
    """Return the images [K, side, side] of points [K, 2 c], x and y of every corner: 1 inside, 0 outside.

    A pixel is inside if a ray from it crosses an odd number of sides.
    """
    x, y = points.view(len(points), -1, 2, 1, 1).unbind(2)
    next_x, next_y = x.roll(-1, 1), y.roll(-1, 1)
    pixel = _pixels(points)
    row, column = pixel[:, None], pixel
    spans = (y > row) != (next_y > row)  # [K, c, side, 1]
    height = torch.where(spans, next_y - y, 1.0)
    crossing = x + (row - y) / height * (next_x - x)
    crossed = (spans & (column < crossing)).sum(1)  # [K, side, side]
    return (crossed % 2).to(points)


def fitting(
    image: Callable[[Tensor], Tensor], solution: Tensor, parameter_error: Callable[[Tensor], float], **given: Any
) -> Task:
    """Return the task of fitting the image of a solution [n], for DISCS and HEXAGON; given: the rest of the task."""
    reference = image(solution[None])[0]

    def loss(x: Tensor) -> Tensor:
        return (image(x) - reference).square().mean((1, 2))

    return Task(
        needs=f"one channel, {SIDE}x{SIDE} pixels; the source has no such task",
        n=len(solution),
        loss=loss,
        evaluations=20_000,
        truth=Truth(lambda x: float(loss(x[None])[0]), parameter_error),
        output=least_squares(image, differences_from(reference)),
        picture=Picture(lambda x: image(x[None])[0].clamp(max=1.0), lambda: reference),
        **given,
    )


def _pixels(like: Tensor) -> Tensor:
    return (torch.arange(SIDE, dtype=like.dtype, device=like.device) + 0.5) / SIDE
