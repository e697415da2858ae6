"""What the Triton kernels draw with: words of Philox, and the quantiles of perturbations.

All numbers have the bits of the references: integers, + - * / sqrt in float64 and + - * in float32, each rounded as
IEEE 754 says, never contracted. No logarithm of the device is used.

Triton 3.6 rounds the constants of comparisons to float32: only numbers that float32 holds are compared with.
"""

import triton
import triton.language as tl

from torch_zerohess.sampling import philox, proposals, quantiles, single

LOG, CENTRAL, MIDDLE, FAR = map(tl.constexpr, (quantiles._LOG, quantiles._CENTRAL, quantiles._MIDDLE, quantiles._FAR))
LN2_HIGH, LN2_LOW = tl.constexpr(quantiles._LN2_HIGH), tl.constexpr(quantiles._LN2_LOW)
EXP_MINUS_HALF, TINY = tl.constexpr(quantiles._EXP_MINUS_HALF), tl.constexpr(quantiles._TINY)
SQRT_HALF_BITS, BELOW_HALF = tl.constexpr(quantiles._SQRT_HALF_BITS), tl.constexpr(single._BELOW_HALF)
TAIL, BOX_HALF_WIDTH = tl.constexpr(single._TAIL), tl.constexpr(proposals.BOX_HALF_WIDTH)
NORMAL, GRADIENT, DIAGONAL, OFF_DIAGONAL, EVERY, BOX, ANY = map(tl.constexpr, range(7))
DIMENSIONS, ROUNDS = tl.constexpr(philox.DIMENSIONS), tl.constexpr(philox._ROUNDS)
FIRST_MULTIPLIER, SECOND_MULTIPLIER = map(tl.constexpr, philox._MULTIPLIERS)
FIRST_WEYL, SECOND_WEYL = map(tl.constexpr, philox._WEYL)


@triton.jit
def words(seed, row, block, stream):
    """Four words of each block [N]. seed, row: of all blocks, or of each [N]."""
    a, b, c, d = block.to(tl.uint32), row.to(tl.uint32), (row >> 32).to(tl.uint32), (0 * block + stream).to(tl.uint32)
    first, second = seed.to(tl.uint32), (seed >> 32).to(tl.uint32)
    for _ in tl.static_range(ROUNDS):  # products of 64 bits take half as many instructions as two halves of 32
        p, q = a.to(tl.uint64) * FIRST_MULTIPLIER, c.to(tl.uint64) * SECOND_MULTIPLIER
        a, b = (q >> 32).to(tl.uint32) ^ b ^ first, q.to(tl.uint32)
        c, d = (p >> 32).to(tl.uint32) ^ d ^ second, p.to(tl.uint32)
        first, second = first + FIRST_WEYL, second + SECOND_WEYL
    return a, b, c, d


@triton.jit
def of_pair(high, low):
    return (((high.to(tl.int64) << 20) | (low.to(tl.int64) >> 12)).to(tl.float64) + 0.5) * 2.0**-52


@triton.jit
def of_word(word):
    return (word.to(tl.float64) + 0.5) * 2.0**-32


@triton.jit
def uniforms_of_columns(seed, row, block, stream):
    a, b, c, d = words(seed, row, block, stream)
    return tl.interleave(of_pair(a, b), of_pair(c, d))


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
    return numerator, denominator


@triton.jit
def normal(p):
    q = p - 0.5
    r = tl.sqrt(-_log(tl.minimum(p, 1.0 - p)))
    above, below = _rational(MIDDLE, r - 1.6)
    if tl.max(r) > 5.0:
        far_above, far_below = _rational(FAR, r - 5.0)
        above, below = tl.where(r <= 5.0, above, far_above), tl.where(r <= 5.0, below, far_below)
    central = tl.abs(q) - 0.425 <= 0.0
    central_above, central_below = _rational(CENTRAL, 0.180625 - q * q)
    ratio = tl.where(central, central_above, above) / tl.where(central, central_below, below)
    return ratio * tl.where(central, q, tl.where(q < 0.0, -1.0, 1.0))


@triton.jit
def _beyond(word):
    """2^32 times the probability beyond the quantile, rounded down: less than 2^31."""
    return word.to(tl.int32, bitcast=True) ^ (word.to(tl.int32, bitcast=True) >> 31)


@triton.jit
def _normal_of_word(word, ratios):
    """In float32; in the tail any numbers. ratios: the table of `single`, two float32 in each int64 [4, 16]."""
    beyond = _beyond(word)
    bits = tl.minimum(beyond.to(tl.float32) + 0.5, BELOW_HALF).to(tl.int32, bitcast=True)
    octave = (bits >> 23) & 15
    t = ((bits & 0x007FFFFF) | 0x3F800000).to(tl.float32, bitcast=True) - 1.5
    ratio = tl.zeros_like(t)
    for k in tl.static_range(4):
        pair = tl.load(ratios + 16 * k + octave)
        first, second = pair.to(tl.int32), (pair >> 32).to(tl.int32)
        ratio = first.to(tl.float32, bitcast=True) if k == 0 else ratio * t + first.to(tl.float32, bitcast=True)
        ratio = ratio * t + second.to(tl.float32, bitcast=True)
    u = ((0x7FFFFFFF - beyond).to(tl.float32) + 0.5) * ratio
    below = ~word.to(tl.int32, bitcast=True) & -0x80000000
    return (u.to(tl.int32, bitcast=True) ^ below).to(tl.float32, bitcast=True)


@triton.jit
def _with_tail(u, word):
    return tl.where(_beyond(word) < TAIL, normal(of_word(word)).to(tl.float32), u)


@triton.jit
def _normals_of_words(a, b, c, d, ratios):
    """Four quantiles of four words: words that are interleaved first would be sent between threads."""
    p, q = _normal_of_word(a, ratios), _normal_of_word(b, ratios)
    r, s = _normal_of_word(c, ratios), _normal_of_word(d, ratios)
    least = tl.minimum(tl.minimum(_beyond(a), _beyond(b)), tl.minimum(_beyond(c), _beyond(d)))
    if tl.min(least) < TAIL:
        p, q = _with_tail(p, a), _with_tail(q, b)
        r, s = _with_tail(r, c), _with_tail(s, d)
    return p, q, r, s


@triton.jit
def gradient_lobe(p):
    radius = tl.sqrt(-2.0 * _log(2.0 * tl.minimum(p, 1.0 - p)))
    return tl.where(p <= 0.5, -radius, radius)


@triton.jit
def hessian_lobe(p):
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


@triton.jit
def _shaped(p, KIND: tl.constexpr):
    if KIND == NORMAL:
        u = normal(p)
    elif KIND == EVERY:
        u = gradient_lobe(p)
    else:
        u = (2.0 * p - 1.0) * BOX_HALF_WIDTH
    return u


@triton.jit
def _of_kind(a, b, c, d, ratios, KIND: tl.constexpr, SINGLE: tl.constexpr):
    """Perturbations of one kind from words [N]: four [N] in float32 where SINGLE, or the same two twice."""
    if SINGLE:
        if KIND == NORMAL:
            p, q, r, s = _normals_of_words(a, b, c, d, ratios)
        else:
            p, q = _shaped(of_word(a), KIND).to(tl.float32), _shaped(of_word(b), KIND).to(tl.float32)
            r, s = _shaped(of_word(c), KIND).to(tl.float32), _shaped(of_word(d), KIND).to(tl.float32)
    else:
        p, q = _shaped(of_pair(a, b), KIND), _shaped(of_pair(c, d), KIND)
        r, s = p, q
    return p, q, r, s


@triton.jit
def _interleaved(p, q, r, s, SINGLE: tl.constexpr):
    return tl.interleave(tl.interleave(p, r), tl.interleave(q, s)) if SINGLE else tl.interleave(p, q)


@triton.jit
def row_of_block(rows, r, R, SINGLE: tl.constexpr, ROWS: tl.constexpr, BLOCK: tl.constexpr):
    """Seed, index and kind of the row of each block of words of a tile: scalars where it has one row."""
    length: tl.constexpr = BLOCK // (4 if SINGLE else 2)
    own = r.to(tl.int64)
    if ROWS > 1:
        own = tl.minimum(own + tl.arange(0, ROWS * length) // length, R - 1)
    return tl.load(rows + 5 * own), tl.load(rows + 5 * own + 1), tl.load(rows + 5 * own + 2).to(tl.int32)


@triton.jit
def perturbations(
    seed, index, kind, ratios, first,
    KIND: tl.constexpr, SINGLE: tl.constexpr, ROWS: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Columns first .. first + BLOCK of the rows of a tile, flat: [ROWS * BLOCK], without lobes of single dimensions.

    seed, index, kind: see `row_of_block`. KIND: NORMAL, EVERY or BOX, if all rows are of this kind; or ANY.
    """
    each: tl.constexpr = 4 if SINGLE else 2
    block = first // each + tl.arange(0, ROWS * BLOCK // each) % (BLOCK // each)
    a, b, c, d = words(seed, index, block, DIMENSIONS)
    if KIND == ANY:
        kind = kind + 0 * block
        p, q, s, t = _of_kind(a, b, c, d, ratios, BOX, SINGLE)
        if tl.min(kind) < EVERY:
            u, v, w, z = _of_kind(a, b, c, d, ratios, NORMAL, SINGLE)
            p, q = tl.where(kind < EVERY, u, p), tl.where(kind < EVERY, v, q)
            s, t = tl.where(kind < EVERY, w, s), tl.where(kind < EVERY, z, t)
        if tl.max((kind == EVERY).to(tl.int32)) > 0:
            u, v, w, z = _of_kind(a, b, c, d, ratios, EVERY, SINGLE)
            p, q = tl.where(kind == EVERY, u, p), tl.where(kind == EVERY, v, q)
            s, t = tl.where(kind == EVERY, w, s), tl.where(kind == EVERY, z, t)
    else:
        p, q, s, t = _of_kind(a, b, c, d, ratios, KIND, SINGLE)
    return _interleaved(p, q, s, t, SINGLE)


@triton.jit
def lobes_of_rows(rows, lobes, r, R, ROWS: tl.constexpr, BLOCK: tl.constexpr):
    """Dimensions i and j of the lobes of a tile's rows, -1 where there is none, and their values."""
    own = r.to(tl.int64)
    if ROWS > 1:
        own = tl.minimum(own + tl.arange(0, ROWS * BLOCK) // BLOCK, R - 1)
    kind = tl.load(rows + 5 * own + 2)
    i = tl.where((kind > NORMAL) & (kind < EVERY), tl.load(rows + 5 * own + 3), -1).to(tl.int32)
    j = tl.where(kind == OFF_DIAGONAL, tl.load(rows + 5 * own + 4), -1).to(tl.int32)
    return i, j, tl.load(lobes + 2 * own), tl.load(lobes + 2 * own + 1)


@triton.jit
def with_lobes(u, column, i, j, u_i, u_j):
    return tl.where(column == j, u_j, tl.where(column == i, u_i, u))
