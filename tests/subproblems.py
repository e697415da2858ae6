"""Quadratic models and a curved valley for tests of steps."""

import torch


def random_problem(seed: int, spectrum: list[float]):
    """Return a Hessian [n, n] with these eigenvalues and a gradient [n]."""
    generator = torch.Generator().manual_seed(seed)
    n = len(spectrum)
    q, _ = torch.linalg.qr(torch.randn(n, n, dtype=torch.float64, generator=generator))
    return q @ torch.diag(torch.tensor(spectrum, dtype=torch.float64)) @ q.mT, torch.randn(
        n, dtype=torch.float64, generator=generator
    )


def rosenbrock(x: torch.Tensor) -> torch.Tensor:
    """Of x [2], with the minimum 0 at (1, 1)."""
    return (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2
