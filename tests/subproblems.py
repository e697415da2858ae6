"""Quadratic models for tests of steps."""

import torch


def random_problem(seed: int, spectrum: list[float]):
    """Return a Hessian [n, n] with these eigenvalues and a gradient [n]."""
    generator = torch.Generator().manual_seed(seed)
    n = len(spectrum)
    q, _ = torch.linalg.qr(torch.randn(n, n, dtype=torch.float64, generator=generator))
    return q @ torch.diag(torch.tensor(spectrum, dtype=torch.float64)) @ q.mT, torch.randn(
        n, dtype=torch.float64, generator=generator
    )
