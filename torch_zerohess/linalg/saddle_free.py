"""Saddle-free Newton steps of a batch, each in a Krylov space of its own, without the Hessians as matrices.

Source: Dauphin, Pascanu, Gulcehre, Cho, Ganguli, Bengio: Identifying and attacking the saddle point problem, 2014.
"""

from collections.abc import Callable

import torch
from torch import Tensor


def saddle_free_steps(
    product: Callable[[Tensor], Tensor],
    gradient: Tensor,
    shift: Tensor,
    factor: Tensor,
    *,
    iterations: int,
    tolerance: float,
) -> tuple[Tensor, bool]:
    """Return steps s [B, n] with (|H| + shift I) s = gradient, and whether each of them reached the tolerance.

    L L^T is the preconditioner. Lanczos builds a basis v_1, ..., v_k of the Krylov space of A = L^-1 (H + shift I) L^-T
    and L^-1 gradient, with full reorthogonalization. T = v^T A v has the eigenvalues a_i + d_i, where d_i is the part
    of the shift. The step is the sum of the eigenvectors of T, each with its share of the gradient, divided by
    |a_i| + d_i.

    As long as T is positive definite and no a_i is negative, this is the step of conjugate gradients. If T has a
    negative eigenvalue, sqrt(a_i^2 + r_i^2) takes the place of |a_i|, where r_i is the residual of eigenvector i: its
    curvature is then the length of its image, of which a part may be outside of the space. So positive and negative
    curvature that cancel within the space, with a_i near 0, do not make the step long. d_i bounds every step.

    All tensors are float64. The bases take 2 B n numbers for each iteration.

    Args:
        product: H v of every element, [B, n] -> [B, n].
        gradient: [B, n].
        shift: positive, [B, 1].
        factor: L, lower triangular, [n, n].
        iterations: products at most.
        tolerance: residual, relative to the gradient, at which an element ends.
    """

    def within(x: Tensor) -> Tensor:
        return torch.linalg.solve_triangular(factor, x.mT, upper=False).mT

    start = within(gradient)
    length, least = start.norm(dim=1, keepdim=True), tolerance * gradient.norm(dim=1, keepdim=True)
    s, going = torch.zeros_like(gradient), length > 0
    v = torch.where(going, start / length, 0.0)
    B, n = gradient.shape
    iterations = min(iterations, n)
    T = gradient.new_zeros(B, iterations, iterations)
    basis, directions = gradient.new_empty(2, B, iterations, n)
    for k in range(iterations):
        w = torch.linalg.solve_triangular(factor.mT, v.mT, upper=True).mT
        image = within(product(w) + shift * w)
        T[:, k, k] = (image * v).sum(1)
        basis[:, k], directions[:, k] = v, w
        known, outward = basis[:, : k + 1], directions[:, : k + 1]
        for _ in range(2):  # twice is enough (Kahan)
            image = image - ((known @ image[..., None]).mT @ known)[:, 0]
        beside = image.norm(dim=1, keepdim=True)

        values, vectors = torch.linalg.eigh(T[:, : k + 1, : k + 1])
        damping = shift * (vectors.mT @ outward).square().sum(2)
        outside = torch.where(values[:, :1] > 0, 0.0, beside * vectors[:, k])
        curvature = torch.hypot(values - damping, outside) + damping
        weights = length * (vectors @ (vectors[:, 0] / curvature)[..., None])[..., 0]

        s = torch.where(going, (weights[:, None] @ outward)[:, 0], s)
        residual = (image @ factor.mT).norm(dim=1, keepdim=True) * weights[:, k:].abs()
        going = going & (residual > least)
        if not bool(going.any()):
            return s, True
        v = torch.where(going, image / beside, 0.0)
        if k + 1 < iterations:
            T[:, k, k + 1] = T[:, k + 1, k] = beside[:, 0]
    return s, False
