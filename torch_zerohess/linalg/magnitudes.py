"""Magnitudes of numbers; matrices with those of their eigenvalues: saddle-free Newton (Dauphin et al. 2014).

Sampled Hessians H = V diag(w) V^T are often indefinite. |H| = V diag(|w|) V^T is not, and so J^T |H| J is not either.
"""

import math

import torch
from torch import Tensor


def magnitudes(matrices: Tensor) -> Tensor:
    """Return symmetric matrices [..., n, n] with the magnitudes of their eigenvalues."""
    values, vectors = torch.linalg.eigh(matrices)
    return (vectors * values.abs()[..., None, :]) @ vectors.mT


def power_of_two(numbers: Tensor) -> float:
    """Return the power of two that divides the largest of some numbers exactly, and leaves it of the size of one.

    It is 1 where all are zero, or one is not finite.
    """
    largest = float(numbers.abs().max())
    return math.ldexp(1.0, math.frexp(largest)[1] - 1) if 0.0 < largest < math.inf else 1.0
