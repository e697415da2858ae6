"""Saddle-free steps in Krylov spaces against dense eigenvalues and solves."""

import pytest
import torch

from torch_zerohess.linalg.saddle_free import saddle_free_steps
from truths import normal

B, N = 6, 20
SHIFT = 0.05


def matrices(values):
    """Symmetric matrices [B, N, N] with these eigenvalues [N], each with eigenvectors of its own."""
    bases = torch.linalg.qr(normal(B, N, N))[0]
    return bases * values @ bases.mT


def steps(h, g, *, factor=None, iterations=N):
    factor = torch.eye(N, dtype=torch.float64) if factor is None else factor
    shift = torch.full((B, 1), SHIFT, dtype=torch.float64)
    return saddle_free_steps(
        lambda v: (h @ v[..., None])[..., 0], g, shift, factor, iterations=iterations, tolerance=1e-12
    )


def dense(h, g):
    """(|H| + SHIFT)^-1 g."""
    values, vectors = torch.linalg.eigh(h)
    return (vectors @ ((vectors.mT @ g[..., None]) / (values.abs() + SHIFT)[..., None]))[..., 0]


VALUES = {
    "mixed": torch.linspace(-2.0, 3.0, N),
    "opposite to the shift": torch.linspace(1.0, 3.0, N).index_fill(0, torch.tensor([3]), -SHIFT),
    "negative": -torch.linspace(1.0, 3.0, N),
}


@pytest.mark.parametrize("values", VALUES.values(), ids=VALUES.keys())
def test_steps_of_a_complete_space_are_those_of_the_magnitudes(values) -> None:
    h, g = matrices(values.double()), normal(B, N, seed=1)
    s, converged = steps(h, g)
    assert converged
    torch.testing.assert_close(s, dense(h, g), rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("iterations", [1, 4])
def test_steps_of_convex_quadratics_are_those_of_conjugate_gradients(iterations: int) -> None:
    """The lowest point of the quadratic in the preconditioned Krylov space."""
    h, g = matrices(torch.logspace(-2, 1, N).double()), normal(B, N, seed=1)
    L = torch.linalg.cholesky(matrices(torch.linspace(0.5, 2.0, N).double())[0])
    s, converged = steps(h, g, factor=L, iterations=iterations)
    assert not converged
    damped, inverse = h + SHIFT * torch.eye(N, dtype=torch.float64), torch.cholesky_inverse(L)
    columns = [g @ inverse]
    for _ in range(iterations - 1):
        columns.append((damped @ columns[-1][..., None])[..., 0] @ inverse)
    space = torch.stack(columns, 2)
    lowest = torch.linalg.solve(space.mT @ damped @ space, space.mT @ g[..., None])
    torch.testing.assert_close(s, (space @ lowest)[..., 0], rtol=1e-6, atol=1e-8)


def test_curvature_that_cancels_makes_no_long_step() -> None:
    """In a space of three dimensions one eigenvalue is near 0, and no eigenvalue of H is."""
    half = torch.linspace(0.5, 2.0, N // 2).double()
    h, g = matrices(torch.cat([half, -half])), normal(B, N, seed=1)
    s, _ = steps(h, g, iterations=3)
    assert bool((s.norm(dim=1) < 2.0 * dense(h, g).norm(dim=1)).all())


def test_the_space_of_a_perfect_preconditioner_has_two_dimensions() -> None:
    values, count = torch.cat([torch.ones(8), -torch.ones(N - 8)]).double(), 0
    h, g = matrices(values), normal(B, N, seed=1)

    def product(v):
        nonlocal count
        count += 1
        return (h @ v[..., None])[..., 0]

    shift = torch.full((B, 1), SHIFT, dtype=torch.float64)
    identity = torch.eye(N, dtype=torch.float64)
    s, converged = saddle_free_steps(product, g, shift, identity, iterations=N, tolerance=1e-9)
    assert converged
    assert count == 2
    torch.testing.assert_close(s, g / (1.0 + SHIFT))


def test_an_element_without_a_gradient_stays() -> None:
    h, g = matrices(VALUES["mixed"].double()), normal(B, N, seed=1)
    g[2] = 0.0
    s, converged = steps(h, g)
    assert converged
    assert not bool(s[2].any())
    torch.testing.assert_close(s, dense(h, g), rtol=1e-6, atol=1e-8)
