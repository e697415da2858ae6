"""Densities to draw perturbations from, and their weights: the literal reference of `csrc/perturb.h`.

u = (z - x) / sigma is dimensionless. Only ratios of densities appear, r(u) = p(u) / N(u): at a thousand dimensions a
density over- or underflows, a ratio does not.

| lobe | r(u) |
|---|---|
| gradient, dimension i | sqrt(pi/2) |u_i| |
| Hessian diagonal i | sqrt(2 pi e)/4 |u_i^2 - 1| |
| Hessian off-diagonal ij | (pi/2) |u_i u_j| |
| first order: mean of the n gradient lobes | sqrt(pi/2) sum |u| / n |
| second order: mean of the n^2 Hessian lobes | [(pi/2)((sum |u|)^2 - sum u^2) + sqrt(2 pi e)/4 sum |u^2-1|] / n^2 |

The aggregate divides by the density of the whole mixture (balance heuristic). Dividing by the density of the one lobe
that was drawn has infinite variance. The mixture always has a Gaussian share and, at order 2, the lobes of both orders,
because the lobe of one order vanishes where the kernel of another does not.
"""

import math

import torch
from torch import Tensor

from torch_zerohess.sampling.philox import DIMENSIONS, PICKS, uniforms, words
from torch_zerohess.sampling.quantiles import gradient_lobe_quantile, hessian_lobe_quantile, normal_quantile
from torch_zerohess.sampling.single import normal_quantile_of_words

NORMAL, GRADIENT_LOBE, DIAGONAL_LOBE, OFF_DIAGONAL_LOBE, EVERY_GRADIENT_LOBE, BOX = range(6)
"""Kinds of rows: column 2 of `rows`."""
GAUSSIAN, FIRST_ORDER, SECOND_ORDER, UNIFORM, SIGNED_LOBES = range(5)
"""Densities of whole rows."""

KIND = {GAUSSIAN: NORMAL, UNIFORM: BOX, SIGNED_LOBES: EVERY_GRADIENT_LOBE}
"""Kind of all rows of the densities that are no mixtures."""

BOX_HALF_WIDTH = 5.0
BOX_COUNTS = 0.35449077018110320546
"""Share of the samples from the box that count, per parameter: (E w)^2 / E w^2 = sqrt(pi) / BOX_HALF_WIDTH."""
_SQRT_HALF_PI = 1.2533141373155003
_HALF_PI = 1.5707963267948966
_DIAGONAL_LOBE_SCALE = 1.0331828385306232  # sqrt(2 pi e) / 4
_LOG_BOX = 1.383646559789373  # log(2 BOX_HALF_WIDTH / sqrt(2 pi))


def pick_rows(seed: int, first: int, count: int, n: int, proposal: int) -> Tensor:
    """Return int64 [count, 5], how each row is made: seed, index, kind, and the dimensions i, j of its lobe."""
    index = torch.arange(first, first + count, device="cpu")
    seeds = torch.full_like(index, seed)
    return mixture_rows(seeds, index, uniforms(seeds, index, 0, 3, PICKS), n, proposal)


def mixture_rows(seeds: Tensor, index: Tensor, p: Tensor, n: int, proposal: int) -> Tensor:
    """Choose component and dimensions of every row's lobe by uniforms p [R, 3]."""
    _check(proposal)
    component = (p[:, 0] * (2 if proposal == FIRST_ORDER else 3)).long()
    i, j = (p[:, 1] * n).long(), (p[:, 2] * n).long()
    hessian = torch.where(i == j, DIAGONAL_LOBE, OFF_DIAGONAL_LOBE)
    kind = torch.where(component == 0, NORMAL, torch.where(component == 1, GRADIENT_LOBE, hessian))
    if proposal in KIND:
        kind = torch.full_like(index, KIND[proposal])
    plain = (kind == NORMAL) | (kind >= EVERY_GRADIENT_LOBE)
    i = torch.where(plain, 0, i)
    return torch.stack([seeds, index, kind, i, torch.where(plain | (kind == GRADIENT_LOBE), i, j)], 1)


def draw(rows: Tensor, n: int, single: bool = False) -> Tensor:
    """Return u, [R, n], for rows as made by `pick_rows`: float64, or float32 from noise of its own where `single`."""
    seed, index = rows[:, 0], rows[:, 1]
    if not single:
        return shape(rows, uniforms(seed, index, 0, n, DIMENSIONS))
    noise = words(seed, index, n, DIMENSIONS)
    return shape(rows, (noise.double() + 0.5) * 2.0**-32, normal_quantile_of_words(noise))


def shape(rows: Tensor, p: Tensor, normal: Tensor | None = None) -> Tensor:
    """Turn uniforms p [R, n] into perturbations of the kinds that `rows` ask for.

    normal: the normal quantiles of p, if they are known; the result has their dtype.
    """
    u = normal_quantile(p) if normal is None else normal
    every, box = rows[:, 2] == EVERY_GRADIENT_LOBE, rows[:, 2] == BOX
    u[every] = gradient_lobe_quantile(p[every]).to(u.dtype)
    u[box] = (BOX_HALF_WIDTH * (2.0 * p[box] - 1.0)).to(u.dtype)
    return with_lobes(rows, u, *(p.gather(1, rows[:, column, None])[:, 0] for column in (3, 4)))


def with_lobes(rows: Tensor, u: Tensor, p_i: Tensor, p_j: Tensor) -> Tensor:
    """Replace dimensions i and j of rows that have a lobe there, from uniforms p_i and p_j [R]."""
    kind, i, j = rows[:, 2], rows[:, 3], rows[:, 4]
    off_diagonal = kind == OFF_DIAGONAL_LOBE
    u = u.clone()
    for chosen, dimension, p, quantile in (
        (kind == DIAGONAL_LOBE, i, p_i, hessian_lobe_quantile),
        ((kind == GRADIENT_LOBE) | off_diagonal, i, p_i, gradient_lobe_quantile),
        (off_diagonal, j, p_j, gradient_lobe_quantile),
    ):
        row = chosen.nonzero()[:, 0]
        u[row, dimension[row]] = quantile(p[row]).to(u.dtype)
    return u


def place(
    u: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, single: bool, proposal: int
) -> tuple[Tensor, Tensor, Tensor]:
    """Return points z = x + sigma u [B, K, n] in the type of x, u [B, K, n] with its signs, and weights [B, K].

    u: [B * S, n], float64 or float32; with `antithetic` K = 2 S and the second half of the rows has the opposite sign.
    x: [B, n] and sigma: [n], float64; `single` rounds z to float32.

    u is returned as it was drawn, not as (z - x) / sigma: the rounding of z acts as dither. With h the distance of x to
    its neighbours, the gradient of a linear function and the Hessian of a quadratic one have a relative bias below 1e-6
    at sigma = h, of -0.014 and 0.13 at h / 2, of -0.57 and 0.73 at h / 4. With (z - x) / sigma and Gaussian
    perturbations it would be 0.08 and 0.22 at h, 0.31 and 1.22 at h / 2.
    """
    u = u.double().view(len(x), -1, u.shape[1])
    if antithetic:
        u = torch.cat([u, -u], 1)
    points = x[:, None] + sigma * u
    return points.float() if single else points, u, weights(u, proposal)


def weights(u: Tensor, proposal: int) -> Tensor:
    """Return N(u) / p(u) for u [..., n]."""
    squares = u * u
    return density_ratio(u.abs().sum(-1), squares.sum(-1), (squares - 1.0).abs().sum(-1), u.shape[-1], proposal)


def density_ratio(l1: Tensor, l2: Tensor, hole: Tensor, n: int, proposal: int) -> Tensor:
    """Return N(u) / p(u) from sum |u|, sum u^2 and sum |u^2 - 1|."""
    _check(proposal)
    if proposal in (GAUSSIAN, SIGNED_LOBES):
        return torch.ones_like(l1)
    if proposal == UNIFORM:
        return torch.exp(n * _LOG_BOX - 0.5 * l2)
    gradient = _SQRT_HALF_PI * (l1 / n)
    if proposal == FIRST_ORDER:
        return 2.0 / (1.0 + gradient)
    return 3.0 / (1.0 + gradient + (_HALF_PI * (l1 * l1 - l2) + _DIAGONAL_LOBE_SCALE * hole) / (n * n))


def _check(proposal: int) -> None:
    if not GAUSSIAN <= proposal <= SIGNED_LOBES:
        raise ValueError(f"proposal is {proposal}, but must be from {GAUSSIAN} to {SIGNED_LOBES}")


def element_rows(seed: int, first: int, samples: int, n: int, order: int) -> Tensor:
    """Rows of optimal sampling: `samples` for the value, for each gradient element and each Hessian element i <= j."""
    i, j = torch.triu_indices(n if order == 2 else 0, n, device="cpu")
    each, value = torch.arange(n, device="cpu"), torch.zeros(1, dtype=torch.int64, device="cpu")
    hessian = torch.where(i == j, DIAGONAL_LOBE, OFF_DIAGONAL_LOBE)
    kind = torch.cat([torch.full_like(value, NORMAL), torch.full_like(each, GRADIENT_LOBE), hessian])
    elements = torch.stack([kind, torch.cat([value, each, i]), torch.cat([value, each, j])], 1)
    elements = elements.repeat_interleave(samples, 0)
    index = first + torch.arange(len(elements), device=elements.device)
    return torch.cat([torch.stack([torch.full_like(index, seed), index], 1), elements], 1)


def element_weights(u: Tensor, rows: Tensor) -> Tensor:
    """Constant weights of optimal sampling, [B, K], each for the element its row was drawn for.

    1 for the value, sign(u_i) sqrt(2/pi), sign(u_i^2 - 1) 4/sqrt(2 pi e) or sign(u_i u_j) 2/pi. u: [B, K, n],
    rows: [K, 5].
    """
    kind = rows[:, 2]
    u_i, u_j = (u.gather(2, rows[:, column].expand(len(u), -1)[..., None])[..., 0] for column in (3, 4))
    gradient = u_i.sign() * math.sqrt(2 / math.pi)
    diagonal, off_diagonal = (u_i.abs() - 1).sign() / _DIAGONAL_LOBE_SCALE, (u_i * u_j).sign() / _HALF_PI
    hessian = torch.where(kind == DIAGONAL_LOBE, diagonal, off_diagonal)
    return torch.where(kind == NORMAL, 1.0, torch.where(kind == GRADIENT_LOBE, gradient, hessian))
