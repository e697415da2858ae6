"""Noise on a CUDA device by Triton kernels: `draw`, `uniforms` and `sample` of `kernels`.

Rows, uniforms, perturbations and points have the bits of the references: integers, + - * / sqrt in float64 and + - * in
float32, each rounded as IEEE 754 says, never contracted. No logarithm of the device is used. Weights are made of sums
of n terms in float64, in another order than elsewhere: they differ by (2 n + 9) 2^-52 of their size at most. For
proposal "uniform" they are exponentials, and differ by (12 n + 8) 2^-52.

Triton 3.6 rounds the constants of comparisons to float32: only numbers that float32 holds are compared with.
"""

import functools
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from torch_zerohess.sampling import kernels, philox, proposals, quantiles, single

_TILE = 1024  # numbers of one program: a block of columns of some rows
_OPTIONS = {"num_warps": 4, "enable_fp_fusion": False}

LOG, CENTRAL, MIDDLE, FAR = map(tl.constexpr, (quantiles._LOG, quantiles._CENTRAL, quantiles._MIDDLE, quantiles._FAR))
LN2_HIGH, LN2_LOW = tl.constexpr(quantiles._LN2_HIGH), tl.constexpr(quantiles._LN2_LOW)
EXP_MINUS_HALF, TINY = tl.constexpr(quantiles._EXP_MINUS_HALF), tl.constexpr(quantiles._TINY)
SQRT_HALF_BITS, BELOW_HALF = tl.constexpr(quantiles._SQRT_HALF_BITS), tl.constexpr(single._BELOW_HALF)
TAIL, BOX_HALF_WIDTH = tl.constexpr(single._TAIL), tl.constexpr(proposals.BOX_HALF_WIDTH)
NORMAL, GRADIENT, DIAGONAL, OFF_DIAGONAL, EVERY, BOX = map(tl.constexpr, range(6))
DIMENSIONS, ROUNDS = tl.constexpr(philox.DIMENSIONS), tl.constexpr(philox._ROUNDS)


@triton.jit
def _words(seed, row, block, stream):
    """Four words for blocks [1, N] or [R, 1] of rows [R, 1]."""
    return tl.philox(seed, block.to(tl.uint32), row.to(tl.uint32), (row >> 32).to(tl.uint32), stream, ROUNDS)


@triton.jit
def _of_pair(high, low):
    return (((high.to(tl.int64) << 20) | (low.to(tl.int64) >> 12)).to(tl.float64) + 0.5) * 2.0**-52


@triton.jit
def _of_word(word):
    return (word.to(tl.float64) + 0.5) * 2.0**-32


@triton.jit
def _uniforms_of_columns(seed, row, block, stream):
    a, b, c, d = _words(seed, row, block, stream)
    return tl.interleave(_of_pair(a, b), _of_pair(c, d))


@triton.jit
def _log_tail(f, half_square):
    s = f / (2.0 + f)
    z = s * s
    r = z * LOG[6] + LOG[5]
    for k in tl.static_range(5):
        r = r * z + LOG[4 - k]
    return s * (half_square + r * z)


@triton.jit
def _log(x):
    bits = x.to(tl.int64, bitcast=True)
    exponent = (bits - SQRT_HALF_BITS) >> 52
    f = (bits - (exponent << 52)).to(tl.float64, bitcast=True) - 1.0
    e = exponent.to(tl.float64)
    half_square = 0.5 * f * f
    return e * LN2_HIGH - ((half_square - (_log_tail(f, half_square) + e * LN2_LOW)) - f)


@triton.jit
def _rational(coefficients: tl.constexpr, r):
    numerator = r * coefficients[0][7] + coefficients[0][6]
    denominator = r * coefficients[1][7] + coefficients[1][6]
    for k in tl.static_range(6):
        numerator = numerator * r + coefficients[0][5 - k]
        denominator = denominator * r + coefficients[1][5 - k]
    return numerator / denominator


@triton.jit
def _normal(p):
    q = p - 0.5
    r = tl.sqrt(-_log(tl.minimum(p, 1.0 - p)))
    tail = _rational(MIDDLE, r - 1.6)
    if tl.max(r) > 5.0:
        tail = tl.where(r <= 5.0, tail, _rational(FAR, r - 5.0))
    tail = tl.where(q < 0.0, -tail, tail)
    return tl.where(tl.abs(q) - 0.425 <= 0.0, q * _rational(CENTRAL, 0.180625 - q * q), tail)


@triton.jit
def _normal_of_words(words, ratios):
    """In float32; ratios: the table of `single`, [8, 16]."""
    upper = words >> 31 == 1
    beyond = tl.where(upper, words ^ 0xFFFFFFFF, words).to(tl.int32)
    bits = tl.minimum(beyond.to(tl.float32) + 0.5, BELOW_HALF).to(tl.int32, bitcast=True)
    octave = (bits >> 23) & 15
    t = ((bits & 0x007FFFFF) | 0x3F800000).to(tl.float32, bitcast=True) - 1.5
    ratio = tl.load(ratios + octave)
    for k in tl.static_range(1, 8):
        ratio = ratio * t + tl.load(ratios + 16 * k + octave)
    u = ((0x7FFFFFFF - beyond).to(tl.float32) + 0.5) * ratio
    u = tl.where(upper, u, -u)
    tail = beyond < TAIL
    if tl.max(tail.to(tl.int32)) > 0:
        u = tl.where(tail, _normal(_of_word(words)).to(tl.float32), u)
    return u


@triton.jit
def _gradient_lobe(p):
    radius = tl.sqrt(-2.0 * _log(2.0 * tl.minimum(p, 1.0 - p)))
    return tl.where(p <= 0.5, -radius, radius)


@triton.jit
def _hessian_lobe(p):
    outer = (p < 0.25) | (p > 0.75)
    y = tl.where(outer, 4.0 * tl.minimum(p, 1.0 - p), tl.abs(4.0 * p - 2.0))
    c = -_log(tl.maximum(y, TINY))
    near = tl.where(outer, tl.sqrt(c), -tl.sqrt(c)) + c / 6.0
    f = tl.where(c - 0.2 < 0.0, near, tl.sqrt(1.0 + 2.0 * c + _log(1.0 + 2.0 * c)) - 1.0)
    small = y * EXP_MINUS_HALF
    t = small + 0.5 * small * small * small
    for _ in tl.static_range(4):  # from one, in f, and from zero, in t
        one = 1.0 + f
        half_square = 0.5 * f * f
        wide = f + half_square - _log(tl.maximum(one, TINY))
        excess = tl.where((f > -0.25) & (f - 0.4 < 0.0), 2.0 * half_square - _log_tail(f, half_square), wide) - c
        slope = f * (2.0 + f) / one
        scale = slope * slope - 0.5 * excess * (1.0 + 1.0 / (one * one))
        f = f - tl.where(scale > 0.0, excess * slope / tl.maximum(scale, TINY), 0.0)
        excess = 0.5 * t * t - _log(tl.maximum(t / tl.maximum(small, TINY), TINY))
        slope = t - 1.0 / tl.maximum(t, TINY)
        scale = slope * slope - 0.5 * excess * (1.0 + 1.0 / tl.maximum(t * t, TINY))
        t = t - tl.where(scale > 0.0, excess * slope / tl.maximum(scale, TINY), 0.0)
    t = tl.where(outer | (c - 0.2 < 0.0), 1.0 + f, t)
    return tl.where(p < 0.5, -t, t)


@triton.jit(do_not_specialize=["R", "first", "count"])
def _uniforms(seeds, indices, out, R, first, count, stream, ROWS: tl.constexpr, BLOCK: tl.constexpr):
    blocks = tl.cdiv(count, BLOCK)
    program = tl.program_id(0).to(tl.int64)
    r, d = program // blocks * ROWS + tl.arange(0, ROWS)[:, None], program % blocks * BLOCK
    seed, row = tl.load(seeds + r, r < R, 0), tl.load(indices + r, r < R, 0)
    p = _uniforms_of_columns(seed, row, (first + d) // 2 + tl.arange(0, BLOCK // 2)[None, :], stream)
    d += tl.arange(0, BLOCK)[None, :]
    tl.store(out + r * count + d, p, (r < R) & (d < count))


@triton.jit
def _uniform_at(seed, row, column, SINGLE: tl.constexpr):
    """Uniform of one column for each row, all [R, 1]."""
    a, b, c, d = _words(seed, row, column // (4 if SINGLE else 2), DIMENSIONS)
    if SINGLE:
        word = tl.where(column % 4 < 2, tl.where(column % 4 == 0, a, b), tl.where(column % 4 == 2, c, d))
        p = _of_word(word)
    else:
        p = tl.where(column % 2 == 0, _of_pair(a, b), _of_pair(c, d))
    return p


@triton.jit
def _shaped(p, KIND: tl.constexpr):
    if KIND == NORMAL:
        u = _normal(p)
    elif KIND == EVERY:
        u = _gradient_lobe(p)
    else:
        u = (2.0 * p - 1.0) * BOX_HALF_WIDTH
    return u


@triton.jit(do_not_specialize=["R"])
def _lobes(rows, values, R, SINGLE: tl.constexpr, ROWS: tl.constexpr, BLOCK: tl.constexpr):
    """Write u_i and u_j of the rows that have a lobe in the dimensions i and j, [R, 2]."""
    r = tl.program_id(0).to(tl.int64) * ROWS + tl.arange(0, ROWS)[:, None]
    seed, row = tl.load(rows + 5 * r, r < R, 0), tl.load(rows + 5 * r + 1, r < R, 0)
    kind = tl.load(rows + 5 * r + 2, r < R, 0)
    for which in tl.static_range(2):
        p = _uniform_at(seed, row, tl.load(rows + 5 * r + 3 + which, r < R, 0), SINGLE)
        u = _gradient_lobe(p)
        if which == 0:
            u = tl.where(kind == DIAGONAL, _hessian_lobe(p), u)
        tl.store(values + 2 * r + which, u.to(values.dtype.element_ty), r < R)


@triton.jit(do_not_specialize=["R", "S", "E"])
def _sample(
    rows, lobes, x, sigma, ratios, points, out, sums, R, S, E, n,
    KIND: tl.constexpr, SINGLE: tl.constexpr, SIGNS: tl.constexpr, ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Draw the rows b * S + s of a kind, NORMAL with or without lobes, EVERY or BOX, and leave the other rows alone.

    Writes row b * E + s of points, row b * SIGNS * S + s of out, and sums of magnitudes; None: does not.
    """
    blocks = tl.cdiv(n, BLOCK)
    program = tl.program_id(0).to(tl.int64)
    r, first = program // blocks * ROWS + tl.arange(0, ROWS)[:, None], program % blocks * BLOCK
    d = first + tl.arange(0, BLOCK)[None, :]
    seed, row = tl.load(rows + 5 * r, r < R, 0), tl.load(rows + 5 * r + 1, r < R, 0)
    kind = tl.load(rows + 5 * r + 2, r < R, -1)
    of_kind = (kind >= 0) & (kind < EVERY) if KIND == NORMAL else kind == KIND
    if tl.max(of_kind.to(tl.int32)) > 0:
        if SINGLE:
            a, b, c, e = _words(seed, row, first // 4 + tl.arange(0, BLOCK // 4)[None, :], DIMENSIONS)
            words = tl.interleave(tl.interleave(a, c), tl.interleave(b, e))
            u = _normal_of_words(words, ratios) if KIND == NORMAL else _shaped(_of_word(words), KIND).to(tl.float32)
        else:
            u = _shaped(
                _uniforms_of_columns(seed, row, first // 2 + tl.arange(0, BLOCK // 2)[None, :], DIMENSIONS), KIND
            )
        if KIND == NORMAL and lobes is not None:
            i, j = tl.load(rows + 5 * r + 3, r < R, 0), tl.load(rows + 5 * r + 4, r < R, 0)
            u = tl.where((kind > NORMAL) & (d == i), tl.load(lobes + 2 * r, r < R, 0.0), u)
            u = tl.where((kind == OFF_DIAGONAL) & (d == j), tl.load(lobes + 2 * r + 1, r < R, 0.0), u)
        mask, b, s, wide = of_kind & (d < n), r // S, r % S, u.to(tl.float64)
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
            place = sums + 3 * (r * blocks + program % blocks)
            size = tl.where(mask, tl.abs(wide), 0.0)
            tl.store(place, tl.sum(size, 1, keep_dims=True), of_kind)
            tl.store(place + 1, tl.sum(size * size, 1, keep_dims=True), of_kind)
            tl.store(place + 2, tl.sum(tl.where(mask, tl.abs(wide * wide - 1.0), 0.0), 1, keep_dims=True), of_kind)


def _launch(kernel: Any, R: int, n: int, *arguments: Any, **constants: int) -> None:
    """Run a kernel on R rows of n columns, on the device of its first argument."""
    block = max(4, min(_TILE, triton.next_power_of_2(n)))
    grid = (triton.cdiv(R, _TILE // block) * triton.cdiv(n, block),)
    if grid[0]:
        with torch.cuda.device_of(arguments[0]):
            kernel[grid](*arguments, **constants, ROWS=_TILE // block, BLOCK=block, **_OPTIONS)


@functools.cache
def _ratios(device: torch.device) -> Tensor:
    return torch.tensor(single._RATIO, dtype=torch.float32, device=device)


def _lobes_of(rows: Tensor, dtype: torch.dtype) -> Tensor:
    values = rows.new_empty(len(rows), 2, dtype=dtype)
    _launch(_lobes, len(rows), 1, rows, values, len(rows), SINGLE=dtype == torch.float32)
    return values


def uniforms(seed: Tensor, row: Tensor, first: int, count: int, stream: int) -> Tensor:
    """See `philox.uniforms`; first is even."""
    out = row.new_empty(len(row), count, dtype=torch.float64)
    _launch(_uniforms, len(row), count, seed, row, out, len(row), first, count, stream)
    return out


def draw(rows: Tensor, n: int, in_single: bool = False) -> Tensor:
    """See `proposals.draw`."""
    R, u = len(rows), rows.new_empty(len(rows), n, dtype=torch.float32 if in_single else torch.float64)
    pointers = rows, _lobes_of(rows, u.dtype), None, None, _ratios(rows.device), None, u, None
    for kind in (proposals.NORMAL, proposals.EVERY_GRADIENT_LOBE, proposals.BOX):
        _launch(_sample, R, n, *pointers, R, R, R, n, KIND=kind, SINGLE=in_single, SIGNS=1)
    return u


def sample(
    seed: int, S: int, x: Tensor, sigma: Tensor, antithetic: bool, proposal: int, center: bool, keep: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """See `kernels.sample`."""
    (B, n), signs, single = x.shape, 2 if antithetic else 1, x.dtype == torch.float32
    rows, mixture = kernels.pick_rows(seed, 0, B * S, n, proposal, x.device), proposal not in proposals.KIND
    points, u = x.new_empty(B, signs * S + center, n), sigma.new_empty(B if keep else 0, signs * S, n)
    lobes = _lobes_of(rows, x.dtype) if mixture else None
    sums = sigma.new_empty(B * S, triton.cdiv(n, _TILE), 3) if mixture or proposal == proposals.UNIFORM else None
    pointers = rows, lobes, x, sigma, _ratios(x.device), points, u if keep else None, sums
    kind = proposals.KIND.get(proposal, proposals.NORMAL)
    _launch(_sample, B * S, n, *pointers, B * S, S, points.shape[1], n, KIND=kind, SINGLE=single, SIGNS=signs)
    if center:
        points[:, -1] = x
    if sums is None:
        return rows, points, u, sigma.new_ones(B, signs * S)
    l1, l2, hole = sums.sum(1).unbind(1)
    return rows, points, u, proposals.density_ratio(l1, l2, hole, n, proposal).view(B, S).repeat(1, signs)
