"""Noise and its sums on a CUDA device by Triton kernels.

`draw`, `uniforms`, `sample`, `project_drawn` and `accumulate_drawn` are those of `kernels`. Rows, uniforms,
perturbations and points have the bits of the references. Sums of n or K terms in float64 are made in another order
than elsewhere, always the same one on a device: weights differ by (2 n + 9) 2^-52 of their size at most. For proposal
"uniform" they are exponentials, and differ by (12 n + 8) 2^-52.
"""

import functools
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from torch_zerohess.sampling import kernels, proposals, single
from torch_zerohess.sampling import triton_quantiles as quantiles
from torch_zerohess.sampling.triton_quantiles import ANY, DIAGONAL, DIMENSIONS

_TILE = 1024  # numbers that a program holds: a block of columns of some rows
_TILES = 4  # blocks of columns that a program draws one after the other
_PROGRAMS = 4096  # among which the tiles of a sum over rows are divided, about
_MANY_VECTORS = 4  # beyond this, rows that are drawn once for all vectors are faster
_OPTIONS = {"num_warps": 4, "enable_fp_fusion": False}


@triton.jit
def _tile(R, ROWS: tl.constexpr, BLOCK: tl.constexpr):
    """Row numbers and columns of this program's first tile, flat, and the first of each."""
    tiles, here = tl.cdiv(R, ROWS), tl.arange(0, ROWS * BLOCK)
    row, column = tl.program_id(0) % tiles * ROWS, tl.program_id(0) // tiles * BLOCK
    return row + here // BLOCK, column + here % BLOCK, row, column


@triton.jit(do_not_specialize=["R", "first", "count"])
def _uniforms(seeds, indices, out, R, first, count, stream, ROWS: tl.constexpr, BLOCK: tl.constexpr):
    r, d, row, column = _tile(R, ROWS, BLOCK)
    half = tl.arange(0, ROWS * BLOCK // 2)
    of_half = tl.minimum(row + half // (BLOCK // 2), R - 1)
    block = (first + column.to(tl.int64)) // 2 + half % (BLOCK // 2)
    p = quantiles.uniforms_of_columns(tl.load(seeds + of_half), tl.load(indices + of_half), block, stream)
    tl.store(out + r.to(tl.int64) * count + d, p, (r < R) & (d < count))


@triton.jit
def _uniform_at(seed, row, column, SINGLE: tl.constexpr):
    """Uniform of one column for each row, all [R]."""
    a, b, c, d = quantiles.words(seed, row, column // (4 if SINGLE else 2), DIMENSIONS)
    if SINGLE:
        word = tl.where(column % 4 < 2, tl.where(column % 4 == 0, a, b), tl.where(column % 4 == 2, c, d))
        p = quantiles.of_word(word)
    else:
        p = tl.where(column % 2 == 0, quantiles.of_pair(a, b), quantiles.of_pair(c, d))
    return p


@triton.jit(do_not_specialize=["R"])
def _lobes(rows, values, R, SINGLE: tl.constexpr, ROWS: tl.constexpr):
    """Write u_i and u_j of the rows that have a lobe in the dimensions i and j, [R, 2]."""
    r = tl.program_id(0) * ROWS + tl.arange(0, ROWS)
    own = rows + 5 * r
    seed, row, kind = tl.load(own, r < R, 0), tl.load(own + 1, r < R, 0), tl.load(own + 2, r < R, 0)
    for which in tl.static_range(2):
        p = _uniform_at(seed, row, tl.load(own + 3 + which, r < R, 0), SINGLE)
        u = quantiles.gradient_lobe(p)
        if which == 0:
            u = tl.where(kind == DIAGONAL, quantiles.hessian_lobe(p), u)
        tl.store(values + 2 * r + which, u.to(values.dtype.element_ty), r < R)


@triton.jit
def _sums_of_rows(values, ROWS: tl.constexpr, BLOCK: tl.constexpr):
    return tl.sum(tl.reshape(values, [ROWS, BLOCK]), 1)


@triton.jit(do_not_specialize=["R", "S", "E"])
def _sample(
    rows, lobes, x, sigma, ratios, points, out, sums, R, S, E, n,
    KIND: tl.constexpr, SINGLE: tl.constexpr, SIGNS: tl.constexpr,
    ROWS: tl.constexpr, BLOCK: tl.constexpr, TILES: tl.constexpr,
):  # fmt: skip
    """Write the row b * E + s of points, row b * SIGNS * S + s of out, and sums of magnitudes; None: does not."""
    tiles, here = tl.cdiv(R, ROWS), tl.arange(0, ROWS * BLOCK)
    row, part = tl.program_id(0) % tiles * ROWS, tl.program_id(0) // tiles
    r = row + here // BLOCK
    b, s = (r // S).to(tl.int64), r % S
    seed, index, kind = quantiles.row_of_block(rows, row, R, SINGLE, ROWS, BLOCK)
    if lobes is not None:
        i, j, u_i, u_j = quantiles.lobes_of_rows(rows, lobes, row, R, ROWS, BLOCK)
    l1, l2, hole = tl.zeros([ROWS], tl.float64), tl.zeros([ROWS], tl.float64), tl.zeros([ROWS], tl.float64)
    for column in range(part * TILES * BLOCK, tl.minimum((part + 1) * TILES * BLOCK, n), BLOCK):
        d = column + here % BLOCK
        mask = (r < R) & (d < n)
        u = quantiles.perturbations(seed, index, kind, ratios, column, KIND, SINGLE, ROWS, BLOCK)
        if lobes is not None:
            u = quantiles.with_lobes(u, d, i, j, u_i, u_j)
        wide = u.to(tl.float64)
        if points is not None:
            centre = tl.load(x + b * n + d, mask, 0.0).to(tl.float64)
            step = tl.load(sigma + d, d < n, 0.0) * wide
            tl.store(points + (b * E + s) * n + d, (centre + step).to(points.dtype.element_ty), mask)
            if SIGNS == 2:
                tl.store(points + (b * E + s + S) * n + d, (centre - step).to(points.dtype.element_ty), mask)
        if out is not None:
            tl.store(out + (b * SIGNS * S + s) * n + d, u.to(out.dtype.element_ty), mask)
            if SIGNS == 2:
                tl.store(out + (b * SIGNS * S + s + S) * n + d, -u.to(out.dtype.element_ty), mask)
        if sums is not None:
            size = tl.where(mask, tl.abs(wide), 0.0)
            l1 += _sums_of_rows(size, ROWS, BLOCK)
            l2 += _sums_of_rows(size * size, ROWS, BLOCK)
            hole += _sums_of_rows(tl.where(mask, tl.abs(wide * wide - 1.0), 0.0), ROWS, BLOCK)
    if sums is not None:
        own = row + tl.arange(0, ROWS)
        to = sums + 3 * (own.to(tl.int64) * tl.cdiv(n, TILES * BLOCK) + part)
        tl.store(to, l1, own < R)
        tl.store(to + 1, l2, own < R)
        tl.store(to + 2, hole, own < R)


@triton.jit(do_not_specialize=["R", "S", "M"])
def _project(
    rows, lobes, ratios, t, out, R, S, M, n,
    KIND: tl.constexpr, SINGLE: tl.constexpr, ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the sum of u[b, s, d] t[b, m, d] over each block of columns, out [B, M, blocks, S]."""
    r, d, row, column = _tile(R, ROWS, BLOCK)
    mask, b, own = (r < R) & (d < n), (r // S).to(tl.int64), row + tl.arange(0, ROWS)
    seed, index, kind = quantiles.row_of_block(rows, row, R, SINGLE, ROWS, BLOCK)
    i, j, u_i, u_j = quantiles.lobes_of_rows(rows, lobes, row, R, ROWS, BLOCK)
    u = quantiles.perturbations(seed, index, kind, ratios, column, KIND, SINGLE, ROWS, BLOCK)
    u = quantiles.with_lobes(u, d, i, j, u_i, u_j).to(tl.float64)
    for m in range(M):
        along = tl.where(mask, u * tl.load(t + (b * M + m) * n + d, mask, 0.0), 0.0)
        place = (((own // S).to(tl.int64) * M + m) * tl.cdiv(n, BLOCK) + column // BLOCK) * S + own % S
        tl.store(out + place, _sums_of_rows(along, ROWS, BLOCK), own < R)


@triton.jit(do_not_specialize=["S", "M", "chunk"])
def _accumulate(
    rows, lobes, ratios, a, out, S, M, n, chunk,
    KIND: tl.constexpr, SINGLE: tl.constexpr, SQUARES: tl.constexpr, ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the sum of a[b, m, s] u[b, s, d] over chunks of rows, out [chunks, B, M, n]; with SQUARES of u^2."""
    column, task, part = tl.program_id(0) * BLOCK, tl.program_id(1).to(tl.int64), tl.program_id(2)
    first, here = task // M * S, tl.arange(0, ROWS * BLOCK)
    d, total = column + here % BLOCK, tl.zeros([ROWS * BLOCK], tl.float64)
    for s in range(part * chunk, tl.minimum((part + 1) * chunk, S), ROWS):
        seed, index, kind = quantiles.row_of_block(rows, first + s, first + S, SINGLE, ROWS, BLOCK)
        i, j, u_i, u_j = quantiles.lobes_of_rows(rows, lobes, first + s, first + S, ROWS, BLOCK)
        u = quantiles.perturbations(seed, index, kind, ratios, column, KIND, SINGLE, ROWS, BLOCK)
        u = quantiles.with_lobes(u, d, i, j, u_i, u_j).to(tl.float64)
        own = s + here // BLOCK
        total += tl.load(a + task * S + own, own < S, 0.0) * (u * u if SQUARES else u)
    d = column + tl.arange(0, BLOCK)
    place = out + (part * tl.num_programs(1).to(tl.int64) + task) * n + d
    tl.store(place, tl.sum(tl.reshape(total, [ROWS, BLOCK]), 0), d < n)


def _size(n: int) -> tuple[int, int]:
    """Return rows and columns of a tile."""
    block = max(4, min(_TILE, triton.next_power_of_2(n)))
    return _TILE // block, block


def _launch(kernel: Any, R: int, parts: int, *arguments: Any, **constants: int | bool) -> None:
    """Run a kernel on parts of R rows, on the device of its first argument."""
    grid = (triton.cdiv(R, constants["ROWS"]) * parts,)
    if grid[0]:
        with torch.cuda.device_of(arguments[0]):
            kernel[grid](*arguments, **constants, **_OPTIONS)


@functools.cache
def _ratios(device: torch.device) -> Tensor:
    table = torch.tensor(single._RATIO, dtype=torch.float32, device="cpu")
    return table.view(4, 2, 16).mT.contiguous().view(torch.int64).to(device)


def _lobes_of(rows: Tensor, dtype: torch.dtype) -> Tensor:
    values = rows.new_empty(len(rows), 2, dtype=dtype)
    _launch(_lobes, len(rows), 1, rows, values, len(rows), SINGLE=dtype == torch.float32, ROWS=_TILE // 4)
    return values


def uniforms(seed: Tensor, row: Tensor, first: int, count: int, stream: int) -> Tensor:
    """See `philox.uniforms`; first is even."""
    out, (height, block) = row.new_empty(len(row), count, dtype=torch.float64), _size(count)
    pointers, parts = (seed.contiguous(), row.contiguous(), out), triton.cdiv(count, block)
    _launch(_uniforms, len(row), parts, *pointers, len(row), first, count, stream, ROWS=height, BLOCK=block)
    return out


def _draw(pointers: tuple[Any, ...], R: int, S: int, E: int, n: int, **constants: int) -> None:
    height, block = _size(n)
    sizes = {"ROWS": height, "BLOCK": block, "TILES": _TILES}
    _launch(_sample, R, _parts(n), *pointers, R, S, E, n, **constants, **sizes)


def _parts(n: int) -> int:
    return int(triton.cdiv(n, _size(n)[1] * _TILES))


def draw(rows: Tensor, n: int, in_single: bool = False) -> Tensor:
    """See `proposals.draw`."""
    R, u = len(rows), rows.new_empty(len(rows), n, dtype=torch.float32 if in_single else torch.float64)
    pointers = rows, _lobes_of(rows, u.dtype), None, None, _ratios(rows.device), None, u, None
    _draw(pointers, R, R, R, n, KIND=ANY.value, SINGLE=in_single, SIGNS=1)
    return u


def sample(
    seed: int, S: int, x: Tensor, sigma: Tensor, antithetic: bool, proposal: int, center: bool, keep: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `kernels.sample`."""
    (B, n), signs, single = x.shape, 2 if antithetic else 1, x.dtype == torch.float32
    picks, mixture = kernels.pick_rows(seed, 0, B * S, n, proposal, torch.device("cpu")), proposal not in proposals.KIND
    rows = picks.pin_memory().to(x.device, non_blocking=True) if x.is_cuda else picks  # does not wait for other work
    points, u = x.new_empty(B, signs * S + center, n), sigma.new_empty(B if keep else 0, signs * S, n)
    lobes = _lobes_of(rows, x.dtype) if mixture else None
    weighted = mixture or proposal == proposals.UNIFORM
    sums = sigma.new_empty(B * S, _parts(n), 3) if weighted else None
    pointers = rows, lobes, x, sigma, _ratios(x.device), points, u if keep else None, sums
    kind = proposals.KIND.get(proposal, proposals.NORMAL)
    _draw(pointers, B * S, S, points.shape[1], n, KIND=kind, SINGLE=single, SIGNS=signs)
    if center:
        points[:, -1] = x
    if sums is None:
        return rows, points, u, sigma.new_ones(B, signs * S)
    l1, l2, hole = sums.sum(1).unbind(1)
    return rows, points, u, proposals.density_ratio(l1, l2, hole, n, proposal).view(B, S).repeat(1, signs)


def project_drawn(rows: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, in_single: bool, t: Tensor) -> Tensor:
    """See `kernels.project_drawn`."""
    (B, M, n), R = t.shape, len(rows)
    S, (height, block) = R // B, _size(n)
    out = t.new_empty(B, M, triton.cdiv(n, block), S)
    pointers = rows, _lobes_of(rows, torch.float32 if in_single else t.dtype), _ratios(x.device), t, out
    constants = {"KIND": ANY.value, "SINGLE": in_single, "ROWS": height, "BLOCK": block}
    _launch(_project, R, out.shape[2], *pointers, R, S, M, n, **constants)
    along = out.sum(2)
    return torch.cat([along, -along], 2) if antithetic else along


def accumulate_drawn(
    rows: Tensor, x: Tensor, sigma: Tensor, antithetic: bool, in_single: bool, a: Tensor, squares: bool
) -> Tensor:
    """See `kernels.accumulate_drawn`."""
    if a.shape[1] > _MANY_VECTORS:
        return kernels.accumulate_drawn(rows, x, sigma, antithetic, in_single, a, squares)
    if antithetic:
        first, second = a.tensor_split(2, 2)
        a = first + second if squares else first - second
    (B, M, S), n = a.shape, x.shape[1]
    height, block = _size(n)
    blocks, tiles = triton.cdiv(n, block), triton.cdiv(S, height)
    chunk = height * triton.cdiv(tiles, max(1, min(tiles, _PROGRAMS // max(1, blocks * B * M))))
    out = a.new_empty(triton.cdiv(S, chunk), B, M, n)
    pointers = rows, _lobes_of(rows, torch.float32 if in_single else a.dtype), _ratios(x.device), a.contiguous(), out
    constants = {"KIND": ANY.value, "SINGLE": in_single, "SQUARES": squares, "ROWS": height, "BLOCK": block}
    if out.numel():
        with torch.cuda.device_of(a):
            _accumulate[(blocks, B * M, len(out))](*pointers, S, M, n, chunk, **constants, **_OPTIONS)
    return out.sum(0)
