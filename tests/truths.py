"""Functions whose convolution with a Gaussian is known in closed form.

Each has `f(z: [K, n]) -> [K, *out]`, the black box, and `smoothed(x: [n], sigma: [n]) -> [*out]`, its convolution with
N(0, diag(sigma^2)) as a differentiable float64 function, so that `torch.func` gives every derivative of the truth.
`f` computes in float64 and rounds its result to the type of z.
"""

import math
from dataclasses import dataclass

import torch
from torch import Tensor


class Truth:
    """Derivatives of the closed form at x: [n] for standard deviations sigma: [n]."""

    def value(self, x: Tensor, sigma: Tensor) -> Tensor:
        return self.smoothed(x, sigma)

    def gradient(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.func.jacrev(self.smoothed)(x, sigma)

    def hessian(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.func.jacrev(torch.func.jacrev(self.smoothed))(x, sigma)


@dataclass(frozen=True)
class Quadratic(Truth):
    """c + b.x + x^T A x / 2."""

    A: Tensor
    b: Tensor
    c: float = 0.0

    def f(self, z: Tensor) -> Tensor:
        y = z.double()
        return (self.c + y @ self.b + 0.5 * ((y @ self.A) * y).sum(1)).to(z.dtype)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return self.c + x @ self.b + 0.5 * x @ self.A @ x + 0.5 * (self.A.diagonal() * sigma**2).sum()


@dataclass(frozen=True)
class PlaneWave(Truth):
    """offset + sin(k.x)."""

    k: Tensor
    offset: float = 0.0

    def f(self, z: Tensor) -> Tensor:
        return (self.offset + torch.sin(z.double() @ self.k)).to(z.dtype)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return self.offset + torch.sin(x @ self.k) * torch.exp(-0.5 * ((self.k * sigma) ** 2).sum())


@dataclass(frozen=True)
class Exponential(Truth):
    """exp(k.x)."""

    k: Tensor

    def f(self, z: Tensor) -> Tensor:
        return torch.exp(z.double() @ self.k).to(z.dtype)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.exp(x @ self.k + 0.5 * ((self.k * sigma) ** 2).sum())


@dataclass(frozen=True)
class Bump(Truth):
    """exp(-|x|^2 / (2 width^2))."""

    width: float

    def f(self, z: Tensor) -> Tensor:
        return torch.exp(-0.5 * (z.double() ** 2).sum(1) / self.width**2).to(z.dtype)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        variance = self.width**2 + sigma**2
        return torch.exp(-0.5 * (x**2 / variance).sum()) * (self.width / variance.sqrt()).prod()


@dataclass(frozen=True)
class Step(Truth):
    """1 where w.x > c, else 0."""

    w: Tensor
    c: float

    def f(self, z: Tensor) -> Tensor:
        return (z.double() @ self.w > self.c).to(z.dtype)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        t = (x @ self.w - self.c) / (self.w * sigma).square().sum().sqrt()
        return 0.5 * torch.erfc(-t / math.sqrt(2))


@dataclass(frozen=True)
class Image(Truth):
    """Several truths as one tensor-valued function, [2, m / 2]."""

    parts: tuple[Truth, ...]

    def f(self, z: Tensor) -> Tensor:
        return torch.stack([part.f(z) for part in self.parts], 1).unflatten(1, (2, -1))

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.stack([part.smoothed(x, sigma) for part in self.parts]).unflatten(0, (2, -1))


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def spread(n: int, low: float, high: float) -> Tensor:
    """Return n different numbers between low and high, in no monotonic order."""
    return low + (high - low) * torch.remainder(0.6180339887498949 * torch.arange(1, n + 1, dtype=torch.float64), 1.0)


def truths(n: int) -> dict[str, Truth]:
    """Return one of each in n dimensions, varying by about one over a distance of one."""
    k = spread(n, -1.2, 1.2) / math.sqrt(n)
    skew = torch.outer(spread(n, -1.0, 1.0), spread(n, 0.2, 1.0)) / n
    quadratic = Quadratic(skew + skew.T + torch.diag(spread(n, -1.0, 1.0)), k, 0.5)
    wave, exponential, bump, step = PlaneWave(k + 0.3), Exponential(k), Bump(1.3), Step(k, 0.1)
    return {
        "quadratic": quadratic,
        "wave": wave,
        "exponential": exponential,
        "bump": bump,
        "step": step,
        "image": Image((wave, exponential, bump, quadratic)),
    }


def deviation(samples: Tensor, truth: Tensor, rounding: float = 0.0) -> float:
    """Return the largest |mean - truth| over the replicates samples [R, ...], in standard errors of that mean.

    `rounding` is a relative error of the truth's largest element that is granted besides.
    """
    mean = samples.double().mean(0)
    error = samples.double().std(0) / math.sqrt(len(samples))
    granted = (rounding + 1e-13) * float(truth.abs().max())
    excess = ((mean - truth).abs() - granted).clamp_min(0.0)
    # Where every replicate is the same number (a noise-free case), only the rounding is granted.
    return float(torch.where(error > 0, excess / error, torch.where(excess > 0, torch.inf, 0.0)).max())
