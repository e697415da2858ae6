"""Black boxes whose behaviour is known: soft squares of the BOX tasks, and functions with a closed-form convolution.

Everything takes points [K, n] and returns values [K]. The closed forms also have `smoothed(x, sigma)`, the convolution
with a Gaussian of standard deviation sigma as a differentiable float64 function, from which torch.func gives the true
gradient and Hessian.
"""

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

_CHUNK = 1 << 16  # pixels rendered at a time: they stay in the cache


class SoftSquares:
    """Mean squared difference between an image of soft squares and the image of the target.

    A square at p has intensity clamp(1 - 2 (|(x - p_x)/w|^e + |(y - p_y)/w|^e), 0, 1), which is zero outside its half
    width w; the image is the sum of all squares, clamped to 1. Centres are clamped so that squares stay inside. Where
    no square overlaps one of the target's, the loss is constant: a plateau.

    Args:
        target: [2 count], x and y of every square, in units of the image side.
        side: pixels along the image side.
        exponent: e, the sharpness of the edge.
        half_width: w, in units of the image side.
    """

    def __init__(self, target: Tensor, *, side: int = 64, exponent: int = 10, half_width: float = 0.1) -> None:
        if target.dim() != 1 or len(target) % 2:
            raise ValueError(f"target must be x and y of every square, [2 count], got {list(target.shape)}")
        self.side, self.exponent, self.half_width = side, exponent, half_width
        self.target = target.double()
        self.count = len(target) // 2
        self._reference = self.image(self.target[None]).flatten()

    def image(self, points: Tensor) -> Tensor:
        """Return the images [K, side, side] (row is y) of points [K, 2 count], in their type."""
        K, w, side = len(points), self.half_width, self.side
        center = points.reshape(K, -1, 2).clamp(w, 1 - w)[..., None]
        # Only the pixels around each square are computed; those of the frame that fall outside have intensity zero.
        pixel = ((center - w) * side).floor() + torch.arange(math.ceil(2 * w * side) + 1, device=points.device)
        power = (((pixel + 0.5) / side - center) / w).abs() ** self.exponent
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

    def starts(self, count: int, seed: int = 0) -> Tensor:
        """Return random starts, [count, n]."""
        generator = torch.Generator().manual_seed(seed)
        uniform = torch.rand(count, len(self.start), generator=generator, dtype=torch.float64)
        return self.start + self.half_range * (2 * uniform - 1)


def box2(side: int = 64) -> BoxTask:
    """One square: target (.3, .3), starts U(.43, .72)^2, sigma a fifth of the side."""
    return BoxTask("BOX2", SoftSquares(_vector(0.3, 0.3), side=side), _vector(0.575, 0.575), 0.145, 1 / 5)


def box10(side: int = 64) -> BoxTask:
    """Five squares that overlap at the start and must spread; sigma a sixth of the side."""
    target = _vector(0.21, 0.21, 0.5, 0.5, 0.79, 0.79, 0.21, 0.79, 0.79, 0.21)
    start = _vector(0.41, 0.41, 0.5, 0.5, 0.59, 0.59, 0.41, 0.59, 0.59, 0.41)
    return BoxTask("BOX10", SoftSquares(target, side=side), start, 0.025, 1 / 6)


class ClosedForm(Protocol):
    """A function with a known Gaussian convolution, both in float64."""

    def __call__(self, points: Tensor) -> Tensor:
        """Return values [K] of points [K, n]."""

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        """Return F(x) = E f(x + sigma u), a scalar, for x [n] and sigma [n] or []; differentiable in x."""


@dataclass(frozen=True)
class Quadratic:
    """1/2 d^T H d + slope . d with d = z - origin and H = Q diag(spectrum) Q, Q the reflection I - 2 w w^T."""

    origin: Tensor
    spectrum: Tensor
    slope: Tensor
    w: Tensor
    """Unit vector [n]; zeros for a diagonal Hessian."""

    def __call__(self, points: Tensor) -> Tensor:
        d = points.double() - self.origin
        reflected = d - 2 * (d @ self.w)[..., None] * self.w
        return 0.5 * (reflected**2 @ self.spectrum) + d @ self.slope

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        # diag(Q D Q)_i = D_i (1 - 4 w_i^2) + 4 w_i^2 w^T D w
        diagonal = self.spectrum * (1 - 4 * self.w**2) + 4 * self.w**2 * (self.w**2 @ self.spectrum)
        return self(x[None])[0] + 0.5 * (sigma**2 * diagonal).sum()


@dataclass(frozen=True)
class PlaneWave:
    """cos(k . (z - origin) + phase); its convolution is damped by exp(-|k sigma|^2 / 2)."""

    origin: Tensor
    k: Tensor
    phase: float = 0.7

    def __call__(self, points: Tensor) -> Tensor:
        return torch.cos((points.double() - self.origin) @ self.k + self.phase)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.exp(-0.5 * ((self.k * sigma) ** 2).sum()) * self(x[None])[0]


@dataclass(frozen=True)
class Exponential:
    """exp(a . (z - origin)); its convolution is larger by exp(|a sigma|^2 / 2)."""

    origin: Tensor
    a: Tensor

    def __call__(self, points: Tensor) -> Tensor:
        return torch.exp((points.double() - self.origin) @ self.a)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.exp(0.5 * ((self.a * sigma) ** 2).sum()) * self(x[None])[0]


@dataclass(frozen=True)
class GaussianBump:
    """exp(-sum ((z - origin) / width)^2 / 2); its convolution is a wider and lower bump."""

    origin: Tensor
    width: Tensor

    def __call__(self, points: Tensor) -> Tensor:
        return torch.exp(-0.5 * (((points.double() - self.origin) / self.width) ** 2).sum(-1))

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        wide = torch.sqrt(self.width**2 + sigma**2)
        return torch.exp(torch.log(self.width / wide).sum() - 0.5 * (((x - self.origin) / wide) ** 2).sum())


@dataclass(frozen=True)
class Step:
    """1 where a . (z - origin) > 0, else 0; its convolution is the normal distribution function."""

    origin: Tensor
    a: Tensor

    def __call__(self, points: Tensor) -> Tensor:
        return ((points.double() - self.origin) @ self.a > 0).double()

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        distance = (x - self.origin) @ self.a / torch.linalg.vector_norm(self.a * sigma)
        probability: Tensor = torch.special.ndtr(distance)
        return probability


def true_gradient(form: ClosedForm, x: Tensor, sigma: Tensor) -> Tensor:
    """Gradient [n] of the convolution, by automatic differentiation of its closed form."""
    gradient: Tensor = torch.func.grad(form.smoothed)(x.double(), sigma)
    return gradient


def true_hessian(form: ClosedForm, x: Tensor, sigma: Tensor) -> Tensor:
    """Hessian [n, n] of the convolution."""
    hessian: Tensor = torch.func.jacrev(torch.func.grad(form.smoothed))(x.double(), sigma)
    return hessian


def true_hvp(form: ClosedForm, x: Tensor, sigma: Tensor, v: Tensor) -> Tensor:
    """Hessian of the convolution times v [n], without the Hessian."""
    product: Tensor = torch.func.grad(lambda z: true_gradient(form, z, sigma) @ v.double())(x.double())
    return product


def _vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)
