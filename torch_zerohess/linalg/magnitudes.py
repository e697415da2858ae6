"""Matrices with the magnitudes of their eigenvalues: saddle-free Newton (Dauphin et al. 2014).

Sampled Hessians H = V diag(w) V^T are often indefinite. |H| = V diag(|w|) V^T is not, and so J^T |H| J is not either.
"""

import torch
from torch import Tensor


def magnitudes(matrices: Tensor) -> Tensor:
    """Return symmetric matrices [..., n, n] with the magnitudes of their eigenvalues."""
    values, vectors = torch.linalg.eigh(matrices)
    return (vectors * values.abs()[..., None, :]) @ vectors.mT
