"""Shapes and types of what the C++ operators return, for tensors without numbers: fake tensors, tracers, compilers.

Shapes: B batch, S samples, K = S or 2 S evaluations per x, n parameters, M vectors, m outputs; see `csrc/*.cpp`.
"""

import math

import torch
from torch import Tensor


def pick_rows(seed: int, first: int, count: int, n: int, proposal: int) -> Tensor:
    return torch.empty(count, 5, dtype=torch.int64, device="cpu")


def draw(rows: Tensor, n: int, single: bool = False) -> Tensor:
    return rows.new_empty(rows.shape[0], n, dtype=torch.float32 if single else torch.float64)


def uniforms(seed: Tensor, row: Tensor, first: int, count: int, stream: int) -> Tensor:
    return row.new_empty(row.shape[0], count, dtype=torch.float64)


def shape(rows: Tensor, p: Tensor) -> Tensor:
    return torch.empty_like(p)


def with_lobes(rows: Tensor, u: Tensor, p_i: Tensor, p_j: Tensor) -> Tensor:
    return torch.empty_like(u)


def sample(
    seed: int, S: int, x: Tensor, sigma: Tensor, antithetic: bool, proposal: int, center: bool, keep: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    B, n = x.shape
    K = 2 * S if antithetic else S
    rows = x.new_empty(B * S, 5, dtype=torch.int64)
    u = sigma.new_empty(B if keep else 0, K, n)
    return rows, x.new_empty(B, K + center, n), u, sigma.new_empty(B, K)


def place(
    u: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, single: bool, proposal: int
) -> tuple[Tensor, Tensor, Tensor]:
    B, n = x.shape
    K = u.shape[0] // B * (2 if antithetic else 1)
    points = u.new_empty(B, K, n, dtype=torch.float32 if single else torch.float64)
    return points, u.new_empty(B, K, n), u.new_empty(B, K)


def project(u: Tensor, t: Tensor) -> Tensor:
    return t.new_empty(t.shape[0], t.shape[1], u.shape[1])


def accumulate(u: Tensor, a: Tensor, squares: bool) -> Tensor:
    return a.new_empty(a.shape[0], a.shape[1], u.shape[2])


def hessian(u: Tensor, a: Tensor) -> Tensor:
    return a.new_empty(a.shape[0], a.shape[1], u.shape[2], u.shape[2])


def project_drawn(rows: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, single: bool, t: Tensor) -> Tensor:
    return t.new_empty(t.shape[0], t.shape[1], rows.shape[0] // x.shape[0] * (2 if antithetic else 1))


def accumulate_drawn(
    rows: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, single: bool, a: Tensor, squares: bool
) -> Tensor:
    return a.new_empty(a.shape[0], a.shape[1], x.shape[1])


def coefficients(values: Tensor, share: Tensor | None, K: int, center: bool) -> Tensor:
    return values.new_empty(values.shape[0], K, math.prod(values.shape[2:]), dtype=torch.float64)


def weighted_gradient(u: Tensor, weight: Tensor, a: Tensor, sigma: Tensor | None = None) -> Tensor:
    return a.new_empty(a.shape[0], a.shape[1], u.shape[2])


def weighted_hvp(u: Tensor, weight: Tensor, a: Tensor, v: Tensor, sigma: Tensor | None = None) -> Tensor:
    return torch.empty_like(v)


def mirror(matrices: Tensor) -> None:
    return None


def sparse_times(column: Tensor, first: Tensor, values: Tensor, vector: Tensor) -> Tensor:
    return vector.new_empty(first.shape[0])


def regress(
    directions: Tensor,
    scale: Tensor,
    changes: Tensor,
    index: Tensor,
    used: Tensor,
    known_index: Tensor,
    known_values: Tensor,
    ridges: Tensor,
    constant: Tensor | None,
    errors: bool,
    shortened: bool,
) -> tuple[Tensor, Tensor, Tensor]:
    m, keep = index.shape
    values = changes.new_empty(ridges.shape[0], m, keep)
    return values, changes.new_empty(m if errors else 0, keep), index.new_empty(())


OPERATORS = (
    *(pick_rows, draw, uniforms, shape, with_lobes, sample, place),
    *(project, accumulate, hessian, mirror, project_drawn, accumulate_drawn),
    *(coefficients, weighted_gradient, weighted_hvp),
    *(sparse_times, regress),
)


def register() -> None:
    """Tell torch the shapes; to be called once, after the operators were loaded."""
    for one in OPERATORS:
        torch.library.register_fake(f"torch_zerohess::{one.__name__}", one)
