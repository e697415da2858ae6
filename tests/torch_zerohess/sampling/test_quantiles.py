"""Inverse CDFs against 60-digit arithmetic: errors in units in the last place (ulps) of the exact result."""

import itertools
import math

import mpmath
import numpy as np
import pytest
import torch
from scipy import integrate

from torch_zerohess.sampling import quantiles, single

mpmath.mp.dps = 60

EPS = 2.0**-53
TINY = [EPS, 3 * EPS, 1e-12, 1e-8, 1e-5, 1e-3]
BRANCH = [1e-15, 1e-12, 1e-9, 1e-6, 1e-4, 1e-2, 0.04, 0.05, 0.1, 0.24]
POINTS = sorted(
    {i / 97 for i in range(1, 97)}
    | set(TINY)
    | {1 - p for p in TINY}
    | {center + sign * step for center in (0.25, 0.5, 0.75) for sign in (-1, 1) for step in [*BRANCH, 2 * EPS]}
    | {0.075, 0.925, math.exp(-25), 0.25, 0.5, 0.75}
)


def normal(p: float) -> mpmath.mpf:
    return mpmath.sqrt(2) * mpmath.erfinv(2 * mpmath.mpf(p) - 1)


def gradient_lobe(p: float) -> mpmath.mpf:
    q = mpmath.mpf(p)
    return -mpmath.sqrt(-2 * mpmath.log(2 * q)) if q <= 0.5 else mpmath.sqrt(-2 * mpmath.log(2 * (1 - q)))


def hessian_lobe(p: float) -> mpmath.mpf:
    q = mpmath.mpf(p)
    outer = q < 0.25 or q > 0.75
    y = 4 * min(q, 1 - q) if outer else abs(4 * q - 2)
    t = mpmath.sqrt(-mpmath.lambertw(-y * y / mpmath.e, -1 if outer else 0).real)
    return -t if q < 0.5 else t


def ulps(got: torch.Tensor, exact: list[mpmath.mpf]) -> list[float]:
    return [
        float(abs(mpmath.mpf(g) - e) / math.ulp(float(e))) if e != 0 else abs(g) / EPS
        for g, e in zip(got.tolist(), exact, strict=True)
    ]


CASES = [
    # The normal quantile is a rational approximation of 1e-16 relative error; the lobes are solved to the end.
    pytest.param(quantiles.normal_quantile, normal, 5.0, id="normal"),
    pytest.param(quantiles.gradient_lobe_quantile, gradient_lobe, 2.0, id="gradient lobe"),
    pytest.param(quantiles.hessian_lobe_quantile, hessian_lobe, 3.0, id="Hessian lobe"),
]


@pytest.mark.parametrize(("quantile", "exact", "most"), CASES)
def test_quantile_against_exact_arithmetic(quantile, exact, most: float) -> None:
    errors = ulps(quantile(torch.tensor(POINTS, dtype=torch.float64)), [exact(p) for p in POINTS])
    worst = int(np.argmax(errors))
    assert errors[worst] <= most, f"{errors[worst]:.1f} ulps at p = {POINTS[worst]!r}"


def test_single_quantile_against_exact_arithmetic() -> None:
    steps = [2**k + d for k in range(31) for d in (-1, 0, 1, 2**k // 3)]  # both ends of every octave, and inside
    lower = sorted({k for k in steps if k < 2**31} | {2**31 - k for k in steps if 0 < k <= 2**31})
    words = torch.tensor(lower)
    got = single.normal_quantile_of_words(words)
    assert got.dtype == torch.float32
    exact = [normal((k + 0.5) / 2**32) for k in lower]
    errors = [
        float(abs(mpmath.mpf(g) - e)) / float(np.spacing(np.float32(abs(e))))
        for g, e in zip(got.tolist(), exact, strict=True)
    ]
    assert max(errors) <= 4.0, f"{max(errors):.1f} ulps at word {lower[int(np.argmax(errors))]}"
    assert torch.equal(single.normal_quantile_of_words(0xFFFFFFFF - words), -got)
    assert bool((got.diff() >= -4 * 2**-24 * got[1:].abs()).all())  # increasing up to rounding


@pytest.mark.parametrize("quantile", [case.values[0] for case in CASES])
def test_quantile_is_odd_and_increasing(quantile) -> None:
    # The numbers that the generator makes, odd multiples of 2^-53: 1 - p is exact.
    k = (torch.linspace(0.0, 0.499, 2000, dtype=torch.float64) * 2**52).long()
    p = (k.double() + 0.5) * 2.0**-52
    u = quantile(p)
    assert bool((u.diff() > 0).all())
    assert bool((u < 0).all())
    assert torch.equal(quantile(1.0 - p), -u)


@pytest.mark.parametrize(
    ("quantile", "density"),
    [
        (quantiles.normal_quantile, lambda u: math.exp(-u * u / 2) / math.sqrt(2 * math.pi)),
        (quantiles.gradient_lobe_quantile, lambda u: abs(u) * math.exp(-u * u / 2) / 2),
        (quantiles.hessian_lobe_quantile, lambda u: math.sqrt(math.e) / 4 * abs(u * u - 1) * math.exp(-u * u / 2)),
    ],
)
def test_quantile_inverts_the_integral_of_its_density(quantile, density) -> None:
    for p in (0.01, 0.2, 0.3, 0.45, 0.6, 0.8, 0.99):
        u = float(quantile(torch.tensor(p, dtype=torch.float64)))
        edges = [-40.0, *[edge for edge in (-1.0, 0.0, 1.0) if edge < u], u]
        mass = sum(integrate.quad(density, a, b, epsabs=1e-14)[0] for a, b in itertools.pairwise(edges))
        assert mass == pytest.approx(p, abs=1e-11)


def test_log_within_one_ulp() -> None:
    x = [1e-300, 1e-20, 0.1, 0.5, math.sqrt(0.5), 0.9, 1 - 1e-9, 1 - EPS, 1.0, 1 + 2 * EPS, 1 + 1e-9, 1.5, 2.0, 1e300]
    x += [math.nextafter(math.sqrt(0.5), 0), math.nextafter(math.sqrt(2), 2), math.sqrt(2)]
    x += np.exp(np.linspace(-40, 40, 400)).tolist()
    errors = ulps(quantiles.log(torch.tensor(x, dtype=torch.float64)), [mpmath.log(mpmath.mpf(v)) for v in x])
    assert max(errors) <= 1.0, f"{max(errors)} ulps at {x[int(np.argmax(errors))]!r}"


def test_sqrt_is_rounded_to_nearest() -> None:
    x = np.concatenate([np.linspace(0.0, 80.0, 5001), np.exp(np.linspace(-80, 20, 5000)), [0.0, 1.0, 4.0, 2.0]])
    got = quantiles.sqrt(torch.tensor(x)).numpy()
    assert np.array_equal(got, np.array([math.sqrt(v) for v in x]))


def test_any_shape_and_noncontiguous() -> None:
    p = torch.linspace(0.01, 0.99, 24, dtype=torch.float64).view(4, 6)
    for quantile in (quantiles.normal_quantile, quantiles.gradient_lobe_quantile, quantiles.hessian_lobe_quantile):
        assert torch.equal(quantile(p.mT), quantile(p.mT.contiguous()))
        assert torch.equal(quantile(p).flatten(), quantile(p.flatten()))
