"""Accuracy against closed forms where arithmetic is hard: extreme scales, offsets, conditioning, sizes.

Errors are dimensionless (gradients times sigma, Hessians times sigma squared) and in units of the standard error that
the estimate itself reports. What exceeds five of them plus the rounding allowance is wrong; for more than a hundred
elements, where the worst of so many is no measure, two in root mean square.

Rounding allowance, per element: 4 eps max|f|, because values arrive as float64 numbers, rounded wherever a black box
rounds them, plus 4 eps' |truth|, eps' of the dtype of x, because the result has that dtype.
"""

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.closed_forms import Bump, ClosedForm, Exponential, PlaneWave, Quadratic, Step
from experiments.reports.progress import progress
from experiments.reports.tables import table

_MOST_STANDARD_ERRORS = 5.0
_MOST_RMS_STANDARD_ERRORS = 2.0
_FEW = 100  # elements up to which each is judged by itself
_FULL = 10  # parameters up to which the full Hessian is judged, with n^2 standard errors
_EPS = {torch.float32: 2.0**-23, torch.float64: 2.0**-52}


@dataclass(frozen=True)
class Case:
    """One black box at one point. `offset` is added to f; `refused` says that an error is the right answer."""

    name: str
    form: ClosedForm
    x: Tensor
    sigma: Tensor
    samples: int = 1024
    offset: float = 0.0
    settings: dict[str, Any] = field(default_factory=dict)
    single_values: bool = False
    """f rounded to float32."""
    refused: bool = False


@dataclass(frozen=True)
class Accuracy:
    """One row of the table. Standard errors are those of the worst element, or their RMS where there are more than 100.

    A dash stands for a relative error where the truth is zero.
    """

    case: str
    quantity: str
    relative_error: float | None
    standard_errors: float | None
    seconds: float
    verdict: str


def stability(*, seed: int = 0, largest: int = 1_000_000, out: Path | None = None) -> list[Accuracy]:
    """Check value, gradient, Hessian diagonal, HVP and Hessian against closed forms on stiff and extreme cases.

    Args:
        seed: of the perturbations.
        largest: parameters of the largest case.
        out: JSON file to write.

    Raises:
        SystemExit: with status 1, if something is wrong.
    """
    rows = [row for case in progress(_cases(largest), "cases") for row in _rows(case, seed)]
    headers = ["case", "quantity", "relative error", "standard errors", "seconds", "verdict"]
    print(table(headers, [list(asdict(row).values()) for row in rows]))
    if out is not None:
        out.parent.mkdir(parents=True, exist_ok=True)
        out.write_text(json.dumps([asdict(row) for row in rows], indent=1))
    wrong = [row for row in rows if row.verdict.startswith("WRONG")]
    print(f"\n{len(rows) - len(wrong)} of {len(rows)} right")
    if wrong:
        raise SystemExit(1)
    return rows


def _cases(largest: int) -> list[Case]:
    return [*_scales(), *_offsets(), *_conditioning(), *_forms(), *_settings(), *_far(), *_sizes(largest)]


def _wave(n: int, sigma: Tensor, x: Tensor) -> PlaneWave:
    """A wave of one radian per sigma along the diagonal: as hard for every sigma and n."""
    k = torch.full((n,), 1 / math.sqrt(n), dtype=torch.float64) / sigma
    return PlaneWave(k, phase=0.7 + math.pi / 2, origin=x.double())


def _wave_case(name: str, sigma: float, x: float = 0.0, dtype: torch.dtype = torch.float64, n: int = 3) -> Case:
    scale = torch.full((n,), sigma, dtype=torch.float64)
    start = torch.full((n,), x, dtype=dtype)
    return Case(name, _wave(n, scale, start), start, scale)


def _scales() -> list[Case]:
    cases = [
        _wave_case(f"sigma {sigma:.0e}, {str(dtype)[6:]}", sigma, dtype=dtype)
        for sigma in (1e-12, 1e-6, 1.0, 1e6, 1e12)
        for dtype in (torch.float64, torch.float32)
    ]
    mixed = torch.logspace(-12, 12, 5, dtype=torch.float64)
    x = torch.zeros(5, dtype=torch.float64)
    return [*cases, Case("sigma 1e-12 to 1e12 in one x", _wave(5, mixed, x), x, mixed)]


def _offsets() -> list[Case]:
    base = _wave_case("", 1.0)
    cases = [
        replace(base, name=f"offset {offset:.0e}, baseline {baseline}", offset=offset, settings={"baseline": baseline})
        for offset in (1e6, 1e12)
        for baseline in ("center", "mean", "none")
    ]
    single = _wave_case("", 1.0, dtype=torch.float32)
    return [
        *cases,
        replace(single, name="offset 1e12, float32 x", offset=1e12),
        replace(single, name="offset 1e4, float32 x and f", offset=1e4, single_values=True),
    ]


def _conditioning() -> list[Case]:
    cases = []
    for decades in (0, 6, 12):
        for n in (2, 10):
            spectrum = torch.logspace(0, -decades, n, dtype=torch.float64)
            w = torch.nn.functional.normalize(torch.arange(1.0, n + 1, dtype=torch.float64), dim=0)
            reflection = torch.eye(n, dtype=torch.float64) - 2 * torch.outer(w, w)
            one = torch.ones(n, dtype=torch.float64)
            form = Quadratic(reflection @ torch.diag(spectrum) @ reflection, one)
            cases.append(Case(f"quadratic, condition 1e{decades}, n = {n}", form, 0.3 * one, one))
    axes = torch.logspace(0, -12, 10, dtype=torch.float64)
    form = Quadratic(torch.diag(axes), torch.zeros_like(axes))
    return [*cases, Case("axis-aligned, condition 1e12, sigma fitted", form, axes**-0.5, axes**-0.5)]


def _forms() -> list[Case]:
    zero = torch.zeros(3, dtype=torch.float64)
    one, a = torch.ones_like(zero), torch.tensor([0.3, -0.5, 0.4], dtype=torch.float64)
    return [
        Case("exponential", Exponential(a), zero, one),
        Case("exponential, f of order 1e100", Exponential(a, zero - 230 / a.sum()), zero, one),
        Case("Gaussian bump of width sigma", Bump(one), zero + 0.5, one),
        Case("step", Step(a), zero + 0.2, one),
        Case("plateau: step at 100 sigma", Step(one, 300.0), zero, one),
    ]


def _settings() -> list[Case]:
    base = _wave_case("", 1.0)
    choices = [("proposal", "gaussian"), ("proposal", "uniform"), ("proposal", "optimal")]
    choices += [("sampler", "sobol"), ("sampler", "orthogonal")]
    return [replace(base, name=f"{key} {value}", settings={key: value}) for key, value in choices]


def _far() -> list[Case]:
    cases = [
        *((x, torch.float64, False) for x in (1e6, 1e12, 1e15)),
        (1e17, torch.float64, True),
        *((x, torch.float32, False) for x in (1e3, 1e6)),
        (1e9, torch.float32, True),
    ]
    return [
        replace(_wave_case(f"x at {x:.0e} sigma, {str(dtype)[6:]}", 1.0, x, dtype), refused=refused)
        for x, dtype, refused in cases
    ]


def _sizes(largest: int) -> list[Case]:
    sizes = [(n, torch.float64) for n in (1, 2, 10, 100, 1000, 10_000, 100_000, 1_000_000)]
    sizes += [(n, torch.float32) for n in (1, 1000)]
    return [
        replace(
            _wave_case(f"n = {n}, {str(dtype)[6:]}", 0.1, dtype=dtype, n=n),
            samples=max(8, min(1024, 8_000_000 // n)),
        )
        for n, dtype in sizes
        if n <= largest
    ]


def _rows(case: Case, seed: int) -> list[Accuracy]:
    largest = 0.0

    def fn(points: Tensor) -> Tensor:
        nonlocal largest
        values = case.form(points) + case.offset
        largest = max(largest, float(values.abs().max()))
        return values.float() if case.single_values else values

    n = len(case.x)
    settings = dict(case.settings)
    samples = case.samples // (1 + n + n * (n + 1) // 2) if settings.get("proposal") == "optimal" else case.samples
    smoothing = zh.Smoothing(sigma=case.sigma, samples=samples, seed=seed, **settings)
    start = time.perf_counter()
    try:
        estimate = zh.estimate(fn, case.x, smoothing, value="smoothed")
    except ValueError as error:
        right = case.refused and "sigma is below the rounding of x" in str(error)
        verdict = "right: refused" if right else f"WRONG: {error}"
        return [Accuracy(case.name, "all", None, None, time.perf_counter() - start, verdict)]
    if case.refused:
        return [Accuracy(case.name, "all", None, None, time.perf_counter() - start, "WRONG: not refused")]
    shared = time.perf_counter() - start
    x, sigma = case.x, case.sigma
    v = sigma * torch.nn.functional.normalize(torch.arange(1.0, n + 1, dtype=torch.float64), dim=0)
    used = v.to(x.dtype)
    noise = _EPS[torch.float32 if case.single_values else torch.float64]

    def row(
        quantity: str, found: Callable[[], Tensor], spread: Callable[[], Tensor], true: Tensor, scale: Tensor
    ) -> Accuracy:
        begin = time.perf_counter()
        result = found().double() * scale
        reported = spread().double() * scale
        seconds = shared + time.perf_counter() - begin
        true = true * scale
        allowance = 4 * noise * largest + 4 * _EPS[x.dtype] * true.abs()
        return _judge(case.name, quantity, result, reported, true, allowance, seconds)

    one = torch.ones((), dtype=torch.float64)
    rows = [
        row(
            "value",
            lambda: estimate.value,
            lambda: estimate.standard_error("value"),
            case.form.value(x, sigma) + case.offset,
            one,
        ),
        row(
            "gradient",
            lambda: estimate.gradient,
            lambda: estimate.standard_error("gradient"),
            case.form.gradient(x, sigma),
            sigma,
        ),
        row(
            "HVP",
            lambda: estimate.hvp(used),
            lambda: estimate.standard_error("hvp", used),
            case.form.hvp(x, sigma, used),
            sigma,
        ),
    ]
    if n <= _FEW:
        hessian = case.form.hessian(x, sigma)
        rows.append(
            row(
                "Hessian diagonal",
                estimate.hessian_diagonal,
                lambda: estimate.standard_error("hessian_diagonal"),
                hessian.diagonal(),
                sigma**2,
            )
        )
        if n <= _FULL:
            scale = torch.outer(sigma, sigma)
            rows.append(row("Hessian", estimate.hessian, lambda: _hessian_error(estimate, n), hessian, scale))
    return rows


def _hessian_error(estimate: zh.Estimate, n: int) -> Tensor:
    """Standard errors [n, n]: column j of the Hessian is the HVP of the j-th unit vector."""
    unit = torch.eye(n, dtype=torch.float64)
    return torch.stack([estimate.standard_error("hvp", column).double() for column in unit], 1)


def _judge(
    case: str, quantity: str, result: Tensor, reported: Tensor, true: Tensor, allowance: Tensor, seconds: float
) -> Accuracy:
    size, difference = float(true.norm()), (result - true).abs()
    relative = float(difference.norm()) / size if size else None
    if not bool(torch.isfinite(result).all() and torch.isfinite(reported).all()):
        return Accuracy(case, quantity, relative, None, seconds, "WRONG: not finite")
    excess = (difference - allowance).clamp_min(0)
    ratios = torch.where(excess > 0, excess / reported, 0.0)
    many = true.numel() > _FEW
    units = float((ratios**2).mean().sqrt() if many else ratios.max())
    most = _MOST_RMS_STANDARD_ERRORS if many else _MOST_STANDARD_ERRORS
    verdict = "right" if units <= most else f"WRONG: more than {most:g} standard errors"
    return Accuracy(case, quantity, relative, units, seconds, verdict)
