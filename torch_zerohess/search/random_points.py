"""Random points of a search, in double precision, from a generator on the CPU whatever the device of the search."""

import torch
from torch import Tensor


def normal(generator: torch.Generator, like: Tensor, *shape: int) -> Tensor:
    """Standard normal numbers on the device of `like`."""
    return torch.randn(*shape, generator=generator, dtype=torch.float64, device="cpu").to(like.device)


def uniform(generator: torch.Generator, lower: Tensor, upper: Tensor, count: int) -> Tensor:
    """Points [count, n] all over the box."""
    unit = torch.rand(count, len(lower), generator=generator, dtype=torch.float64, device="cpu").to(lower.device)
    return lower + (upper - lower) * unit


def reflect(z: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Mirror points [K, n] into the box; points that are still outside are moved to its sides."""
    z = torch.where(z < lower, 2 * lower - z, z)
    z = torch.where(z > upper, 2 * upper - z, z)
    return z.clamp(lower, upper)
