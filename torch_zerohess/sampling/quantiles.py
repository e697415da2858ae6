"""Inverse CDFs of the normal density and of the lobes of its first and second derivative.

Written with additions, multiplications, divisions and square roots alone, which IEEE 754 rounds in one way only:
`csrc/quantiles.h` does the same operations in the same order and returns the same bits on every machine and device.
All functions take and return float64 tensors of any shape.
"""

import torch
from torch import Tensor

# Coefficients of log(1 + f) = f - f^2/2 + s (f^2/2 + R(s^2)), s = f / (2 + f) (Sun's fdlibm, e_log.c).
_LOG = (
    6.666666666666735130e-01,
    3.999999999940941908e-01,
    2.857142874366239149e-01,
    2.222219843214978396e-01,
    1.818357216161805012e-01,
    1.531383769920937332e-01,
    1.479819860511658591e-01,
)
_LN2_HIGH, _LN2_LOW = 6.93147180369123816490e-01, 1.90821492927058770002e-10
_SQRT_HALF_BITS = 0x3FE6A09E667F3BCD
_EXP_MINUS_HALF = 0.6065306597126334
_TINY = 2.0**-500

# Wichura's algorithm AS 241 (1988), PPND16: numerators and denominators of the central, middle and far branch.
_CENTRAL = (
    (
        3.3871328727963666080e0,
        1.3314166789178437745e2,
        1.9715909503065514427e3,
        1.3731693765509461125e4,
        4.5921953931549871457e4,
        6.7265770927008700853e4,
        3.3430575583588128105e4,
        2.5090809287301226727e3,
    ),
    (
        1.0,
        4.2313330701600911252e1,
        6.8718700749205790830e2,
        5.3941960214247511077e3,
        2.1213794301586595867e4,
        3.9307895800092710610e4,
        2.8729085735721942674e4,
        5.2264952788528545610e3,
    ),
)
_MIDDLE = (
    (
        1.42343711074968357734e0,
        4.63033784615654529590e0,
        5.76949722146069140550e0,
        3.64784832476320460504e0,
        1.27045825245236838258e0,
        2.41780725177450611770e-1,
        2.27238449892691845833e-2,
        7.74545014278341407640e-4,
    ),
    (
        1.0,
        2.05319162663775882187e0,
        1.67638483018380384940e0,
        6.89767334985100004550e-1,
        1.48103976427480074590e-1,
        1.51986665636164571966e-2,
        5.47593808499534494600e-4,
        1.05075007164441684324e-9,
    ),
)
_FAR = (
    (
        6.65790464350110377720e0,
        5.46378491116411436990e0,
        1.78482653991729133580e0,
        2.96560571828504891230e-1,
        2.65321895265761230930e-2,
        1.24266094738807843860e-3,
        2.71155556874348757815e-5,
        2.01033439929228813265e-7,
    ),
    (
        1.0,
        5.99832206555887937690e-1,
        1.36929880922735805310e-1,
        1.48753612908506148525e-2,
        7.86869131145613259100e-4,
        1.84631831751005468180e-5,
        1.42151175831644588870e-7,
        2.04426310338993978564e-15,
    ),
)


def log(x: Tensor) -> Tensor:
    """Natural logarithm of normal positive numbers, within 1 ulp, also in relative terms next to x = 1."""
    bits = x.contiguous().view(torch.int64)
    exponent = (bits - _SQRT_HALF_BITS) >> 52
    f = (bits - (exponent << 52)).view(torch.float64) - 1.0
    e = exponent.double()
    half_square = 0.5 * f * f
    return e * _LN2_HIGH - ((half_square - (_log_tail(f, half_square) + e * _LN2_LOW)) - f)


def sqrt(x: Tensor) -> Tensor:
    """Square root rounded to nearest, which `torch.sqrt` is not on every CPU: its result, corrected by x - s^2 exactly.

    The residual is exact by Dekker's product (1971).
    """
    s = x.sqrt()
    wide = 134217729.0 * s  # 2^27 + 1 splits s into two halves of 26 bits
    high = wide - (wide - s)
    low = s - high
    residual = ((x - high * high) - 2.0 * high * low) - low * low
    return torch.where(s > 0.0, s + residual / (2.0 * s).clamp_min(_TINY), s)


def normal_quantile(p: Tensor) -> Tensor:
    """Inverse CDF of the standard normal, p in (0, 1)."""
    q = p - 0.5
    central = q * _rational(_CENTRAL, 0.180625 - q * q)
    r = sqrt(-log(torch.minimum(p, 1.0 - p)))
    tail = torch.where(r <= 5.0, _rational(_MIDDLE, r - 1.6), _rational(_FAR, r - 5.0))
    return torch.where(q.abs() <= 0.425, central, torch.where(q < 0.0, -tail, tail))


def gradient_lobe_quantile(p: Tensor) -> Tensor:
    """Inverse CDF of the density |u| exp(-u^2/2) / 2, p in (0, 1) (Fischer and Ritschel 2023)."""
    left = p <= 0.5
    radius = sqrt(-2.0 * log(2.0 * torch.where(left, p, 1.0 - p)))
    return torch.where(left, -radius, radius)


def hessian_lobe_quantile(p: Tensor) -> Tensor:
    """Inverse CDF of the density sqrt(e)/4 |u^2 - 1| exp(-u^2/2), p in [1e-150, 1).

    The CDF is P = |u|/4 exp((1-u^2)/2) for u < -1, 1/2 + u/4 exp((1-u^2)/2) inside, 1 - u/4 exp((1-u^2)/2) for u > 1
    (supplement, Eq. 52, whose second and third branch carry the wrong sign and offset in print). Hence
    |u| = sqrt(-W(-y^2/e)) with the Lambert-W branch W_-1 in the tails, y = 4P or 4(1-P), and W_0 inside, y = |4P-2|.
    We solve the same equation as (t^2-1)/2 - log t = -log y, t = |u|, which does not cancel at the branch point t = 1.
    """
    left, right = p < 0.25, p > 0.75
    outer = left | right
    y = torch.where(left, 4.0 * p, torch.where(right, 4.0 * (1.0 - p), (4.0 * p - 2.0).abs()))
    c = -log(y.clamp_min(_TINY))
    t = torch.where(outer | (c < 0.2), _solve_from_one(c, outer), _solve_from_zero(y * _EXP_MINUS_HALF))
    return torch.where(left | (~right & (p < 0.5)), -t, t)


def _solve_from_one(c: Tensor, outer: Tensor) -> Tensor:
    """Solve (t^2-1)/2 - log t = c by Halley's method in f = t - 1, on the side of t = 1 that `outer` says."""
    root = sqrt(c)
    near = torch.where(outer, root, -root) + c / 6.0
    f = torch.where(c < 0.2, near, sqrt(1.0 + 2.0 * c + log(1.0 + 2.0 * c)) - 1.0)
    for _ in range(4):
        t = 1.0 + f
        half_square = 0.5 * f * f
        wide = f + half_square - log(t.clamp_min(_TINY))
        excess = torch.where((f > -0.25) & (f < 0.4), 2.0 * half_square - _log_tail(f, half_square), wide) - c
        slope = f * (2.0 + f) / t
        scale = slope * slope - 0.5 * excess * (1.0 + 1.0 / (t * t))
        f = f - torch.where(scale > 0.0, excess * slope / scale.clamp_min(_TINY), 0.0)
    return 1.0 + f


def _solve_from_zero(small: Tensor) -> Tensor:
    """Solve t^2/2 = log(t / small), t < 1, by Halley's method: accurate in relative terms down to t = 0."""
    t = small + 0.5 * small * small * small
    for _ in range(4):
        excess = 0.5 * t * t - log((t / small.clamp_min(_TINY)).clamp_min(_TINY))
        slope = t - 1.0 / t.clamp_min(_TINY)
        scale = slope * slope - 0.5 * excess * (1.0 + 1.0 / (t * t).clamp_min(_TINY))
        t = t - torch.where(scale > 0.0, excess * slope / scale.clamp_min(_TINY), 0.0)
    return t


def _log_tail(f: Tensor, half_square: Tensor) -> Tensor:
    """S (f^2/2 + R(s^2)): what log(1 + f) has beyond f - f^2/2."""
    s = f / (2.0 + f)
    z = s * s
    r = torch.full_like(z, _LOG[6])
    for coefficient in reversed(_LOG[:6]):
        r = r * z + coefficient
    return s * (half_square + r * z)


def _rational(coefficients: tuple[tuple[float, ...], tuple[float, ...]], r: Tensor) -> Tensor:
    numerator = torch.full_like(r, coefficients[0][7])
    denominator = torch.full_like(r, coefficients[1][7])
    for a, b in zip(reversed(coefficients[0][:7]), reversed(coefficients[1][:7]), strict=True):
        numerator, denominator = numerator * r + a, denominator * r + b
    return numerator / denominator
