"""Soft squares drawn into an image, the black box of the BOX tasks: a loss with plateaus and no closed form."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

HALF_WIDTH = 0.1
"""Of a square, in units of the image side."""
EXPONENT = 10
"""Sharpness of the edge of a square."""
_CHUNK = 1 << 16  # pixels rendered at a time: they stay in the cache


class SoftSquares:
    """Mean squared difference between an image of soft squares and the image of the target.

    A square at p has intensity clamp(1 - 2 (|(x - p_x)/w|^e + |(y - p_y)/w|^e), 0, 1), which is zero outside its half
    width w; the image is the sum of all squares, clamped to 1. Centres are clamped so that squares stay inside. Where
    no square overlaps one of the target's, the loss is constant: a plateau.

    w is `HALF_WIDTH` and e is `EXPONENT`.

    Args:
        target: [2 count], x and y of every square, in units of the image side; float64.
        side: pixels along the image side.
    """

    def __init__(self, target: Tensor, side: int) -> None:
        self.side, self.target = side, target
        self._reference = self.image(self.target[None]).flatten()

    def image(self, points: Tensor) -> Tensor:
        """Return the images [K, side, side] (row is y) of points [K, 2 count], in their type."""
        K, w, side = len(points), HALF_WIDTH, self.side
        center = points.reshape(K, -1, 2).clamp(w, 1 - w)[..., None]
        # Only the pixels around each square are computed; of these, pixels outside of the image have intensity zero.
        pixel = ((center - w) * side).floor() + torch.arange(math.ceil(2 * w * side) + 1, device=points.device)
        power = (((pixel + 0.5) / side - center) / w).abs() ** EXPONENT
        square = (1 - 2 * (power[:, :, 1, :, None] + power[:, :, 0, None, :])).clamp_(0, 1)
        index = pixel.long().clamp_(0, side - 1)
        index = index[:, :, 1, :, None] * side + index[:, :, 0, None, :]
        image = points.new_zeros(K, side * side).scatter_add_(1, index.flatten(1), square.flatten(1))
        return image.clamp_(max=1).view(K, side, side)

    def __call__(self, points: Tensor) -> Tensor:
        """Return the loss [K] of points [K, 2 count]."""
        reference = self._reference.to(points)
        losses = []
        for part in points.split(max(1, _CHUNK // self.side**2)):
            difference = self.image(part).flatten(1).sub_(reference)
            losses.append(torch.linalg.vecdot(difference, difference) / self.side**2)
        return torch.cat(losses)


@dataclass(frozen=True)
class BoxTask:
    """Soft squares that must find their places, from starts uniform in start +- half_range, with the sigma to begin."""

    name: str
    loss: SoftSquares
    start: Tensor
    half_range: float
    sigma: float


def box2(side: int = 64) -> BoxTask:
    """One square: target (.3, .3), starts U(.43, .72)^2, sigma a fifth of the side."""
    return BoxTask("BOX2", SoftSquares(_vector(0.3, 0.3), side), _vector(0.575, 0.575), 0.145, 1 / 5)


def box10(side: int = 64) -> BoxTask:
    """Five squares that overlap at the start and must spread; sigma a sixth of the side."""
    target = _vector(0.21, 0.21, 0.5, 0.5, 0.79, 0.79, 0.21, 0.79, 0.79, 0.21)
    start = _vector(0.41, 0.41, 0.5, 0.5, 0.59, 0.59, 0.41, 0.59, 0.59, 0.41)
    return BoxTask("BOX10", SoftSquares(target, side), start, 0.025, 1 / 6)


def _vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)
