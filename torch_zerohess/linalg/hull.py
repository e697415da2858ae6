"""The shortest vector in the convex hull of others."""

import torch
from torch import Tensor

_STEPS = 1000
"""Steps of the accelerated projected gradient."""


def shortest(vectors: Tensor) -> Tensor:
    """Return the shortest vector [n] in the convex hull of vectors [m, n], up to about 1e-3 of their lengths."""
    m = len(vectors)
    products = vectors @ vectors.mT
    curvature = float(torch.linalg.matrix_norm(products)) or 1.0
    counts = torch.arange(1, m + 1, device=vectors.device)
    weights = ahead = vectors.new_full((m,), 1.0 / m)
    pace = 1.0
    for _ in range(_STEPS):
        wanted = ahead - (products @ ahead) / curvature
        ordered = wanted.sort(descending=True).values
        excess = (ordered.cumsum(0) - 1.0) / counts
        after = (wanted - excess[int((ordered > excess).sum()) - 1]).clamp(min=0.0)  # onto the simplex
        faster = 0.5 * (1.0 + (1.0 + 4.0 * pace * pace) ** 0.5)
        ahead = after + (pace - 1.0) / faster * (after - weights)
        weights, pace = after, faster
    return weights @ vectors
