"""Functions whose convolution with a Gaussian is known in closed form: the truth that estimates are compared with.

Needs torch alone, so that the tests of the library take their truth from here too.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor


class ClosedForm(ABC):
    """A function f and its convolution F(x) = E f(x + sigma u), u standard normal.

    Shapes: points z [K, n], x [n], sigma [n] or []. Values are scalars unless a subclass says otherwise.
    """

    @abstractmethod
    def __call__(self, z: Tensor) -> Tensor:
        """Return the values [K] at z in float64."""

    @abstractmethod
    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        """Return the convolution [] at x, in float64; differentiable in x, to any order."""

    def f(self, z: Tensor) -> Tensor:
        """Return the values [K] at z, computed in float64 and rounded to the type of z."""
        return self(z).to(z.dtype)

    def value(self, x: Tensor, sigma: Tensor) -> Tensor:
        """Return the convolution [] at x."""
        return self.smoothed(x.double(), sigma)

    def gradient(self, x: Tensor, sigma: Tensor) -> Tensor:
        """Return the gradient of F [n], by automatic differentiation of the closed form."""
        gradient: Tensor = torch.func.jacrev(self.smoothed)(x.double(), sigma)
        return gradient

    def hessian(self, x: Tensor, sigma: Tensor) -> Tensor:
        """Return the Hessian of F [n, n]."""
        hessian: Tensor = torch.func.jacrev(torch.func.jacrev(self.smoothed))(x.double(), sigma)
        return hessian

    def hvp(self, x: Tensor, sigma: Tensor, v: Tensor) -> Tensor:
        """Return the Hessian of F times v [n], without the Hessian."""
        product: Tensor = torch.func.grad(lambda z: self.gradient(z, sigma) @ v.double())(x.double())
        return product


@dataclass(frozen=True)
class Quadratic(ClosedForm):
    """c + b . z + z^T A z / 2; the convolution adds half the trace of sigma A sigma."""

    A: Tensor
    """[n, n], symmetric."""
    b: Tensor
    c: float = 0.0

    def __call__(self, z: Tensor) -> Tensor:
        y = z.double()
        return self.c + y @ self.b + 0.5 * ((y @ self.A) * y).sum(1)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return self.c + x @ self.b + 0.5 * x @ self.A @ x + 0.5 * (self.A.diagonal() * sigma**2).sum()


@dataclass(frozen=True)
class PlaneWave(ClosedForm):
    """offset + sin(k . (z - origin) + phase); the convolution damps the wave by exp(-|k sigma|^2 / 2)."""

    k: Tensor
    offset: float = 0.0
    phase: float = 0.0
    origin: Tensor | float = 0.0

    def __call__(self, z: Tensor) -> Tensor:
        return self.offset + torch.sin((z.double() - self.origin) @ self.k + self.phase)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        damping = torch.exp(-0.5 * ((self.k * sigma) ** 2).sum())
        return self.offset + damping * torch.sin((x - self.origin) @ self.k + self.phase)


@dataclass(frozen=True)
class Exponential(ClosedForm):
    """exp(k . (z - origin)); the convolution multiplies it by exp(|k sigma|^2 / 2)."""

    k: Tensor
    origin: Tensor | float = 0.0

    def __call__(self, z: Tensor) -> Tensor:
        return torch.exp((z.double() - self.origin) @ self.k)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.exp((x - self.origin) @ self.k + 0.5 * ((self.k * sigma) ** 2).sum())


@dataclass(frozen=True)
class Bump(ClosedForm):
    """exp(-|(z - origin) / width|^2 / 2); the convolution is a wider and lower bump."""

    width: Tensor | float
    """[n], or one for all dimensions."""
    origin: Tensor | float = 0.0

    def __call__(self, z: Tensor) -> Tensor:
        return torch.exp(-0.5 * (((z.double() - self.origin) / self.width) ** 2).sum(1))

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        variance = self.width**2 + sigma**2
        return torch.exp(-0.5 * ((x - self.origin) ** 2 / variance).sum()) * (self.width / variance.sqrt()).prod()


@dataclass(frozen=True)
class Step(ClosedForm):
    """1 where w . z > c, else 0; the convolution is the normal distribution function."""

    w: Tensor
    c: float = 0.0

    def __call__(self, z: Tensor) -> Tensor:
        return (z.double() @ self.w > self.c).double()

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        distance = (x @ self.w - self.c) / (self.w * sigma).square().sum().sqrt()
        return 0.5 * torch.erfc(-distance / math.sqrt(2))
