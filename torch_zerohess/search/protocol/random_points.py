"""Random points of a search, from a generator on the CPU whatever the device of the search."""

import torch
from torch import Tensor


def normal(generator: torch.Generator, like: Tensor, *shape: int) -> Tensor:
    """Standard normal numbers on the device of `like`."""
    return torch.randn(*shape, generator=generator, dtype=torch.float64, device="cpu").to(like.device)


def fractions(generator: torch.Generator, *shape: int) -> Tensor:
    """Uniform random numbers from 0 to 1, on the CPU."""
    return torch.rand(shape, generator=generator, dtype=torch.float32, device="cpu")


def uniform(generator: torch.Generator, lower: Tensor, upper: Tensor, count: int) -> Tensor:
    """Points [count, n] all over the box."""
    unit = torch.rand(count, len(lower), generator=generator, dtype=torch.float64, device="cpu").to(lower.device)
    return lower + (upper - lower) * unit


def orthonormal(columns: Tensor) -> Tensor:
    """Return an orthonormal basis of normal columns [n, k], uniformly distributed (Mezzadri 2007).

    Q of a QR decomposition is not: Householder's reflections choose the signs of its first entries.
    """
    q, r = torch.linalg.qr(columns)
    return q * torch.where(r.diagonal() < 0, -1.0, 1.0).to(q)


def reflect(z: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Mirror points [K, n] into the box; points that are still outside are moved to its sides."""
    z = torch.where(z < lower, 2 * lower - z, z)
    z = torch.where(z > upper, 2 * upper - z, z)
    return z.clamp(lower, upper)
