"""The cases of the stability study: one black box at one point each, with its closed form."""

import math
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor

from experiments.problems.closed_forms import Bump, ClosedForm, Exponential, PlaneWave, Quadratic, Step

Refusal = Literal["", "everything", "Hessian"]


@dataclass(frozen=True)
class Scaled(ClosedForm):
    """size * form((z - origin) / unit)."""

    form: ClosedForm
    origin: Tensor
    unit: Tensor
    size: float

    def __call__(self, z: Tensor) -> Tensor:
        return self.size * self.form((z.double() - self.origin) / self.unit)

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return self.size * self.form.smoothed((x - self.origin) / self.unit, sigma / self.unit)


@dataclass(frozen=True)
class Case:
    """One black box at one point. `offset` is added to f; `refused` says where an error is the right answer."""

    name: str
    form: ClosedForm
    x: Tensor
    sigma: Tensor
    samples: int = 1024
    offset: float = 0.0
    settings: dict[str, Any] = field(default_factory=dict)
    single_values: bool = False
    """f rounded to float32."""
    refused: Refusal = ""


def cases(largest: int) -> list[Case]:
    """Return all cases of up to `largest` parameters."""
    return [
        *(*_scales(), *_extremes(), *_offsets(), *_conditioning(), *_forms(), *_settings(), *_far(), *_rounding()),
        *_sizes(largest),
    ]


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


def _extremes() -> list[Case]:
    """Where the square of sigma, or of f, is not a number of float64."""
    wave, zero = _wave_case("", 1.0), torch.zeros(3, dtype=torch.float64)

    def scaled(name: str, sigma: float, size: float, refused: Refusal) -> Case:
        form = Scaled(wave.form, zero, torch.tensor(sigma, dtype=torch.float64), size)
        return replace(wave, name=name, form=form, sigma=wave.sigma * sigma, refused=refused)

    return [
        scaled("sigma 1e-150", 1e-150, 1.0, ""),
        scaled("sigma 1e+150", 1e150, 1.0, ""),
        scaled("sigma 1e-160: Hessians of order 1e320", 1e-160, 1.0, "Hessian"),
        scaled("sigma 1e+308", 1e308, 1.0, "everything"),
        scaled("f of order 1e-300", 1.0, 1e-300, ""),
        scaled("f of order 1e+300", 1.0, 1e300, ""),
    ]


def _rounding() -> list[Case]:
    """Products of two parameters and slopes, whose expectations rounding does not change: see `proposals.place`."""
    ones = torch.ones(3, dtype=torch.float64)
    form = Quadratic(torch.outer(ones, ones) - torch.diag(ones), 0.5 * ones)
    cases = []
    for dtype, step in ((torch.float64, 2.0**-52), (torch.float32, 2.0**-23)):
        x = torch.full((3,), 1.5, dtype=dtype)
        for ulps in (1, 4):
            sigma = ulps * step * ones
            scaled = Scaled(form, x.double(), sigma[0], 1.0)
            cases += [
                Case(
                    f"sigma = {ulps} ulp of x, {str(dtype)[6:]}, {proposal}",
                    scaled,
                    x,
                    sigma,
                    settings={"proposal": proposal},
                )
                for proposal in ("aggregate", "gaussian", "optimal")
            ]
    return cases


def _offsets() -> list[Case]:
    base = _wave_case("", 1.0)
    cases = [
        replace(base, name=f"offset {offset:.0e}, baseline {baseline}", offset=offset, settings={"baseline": baseline})
        for offset in (1e6, 1e12)
        for baseline in ("center", "mean", "none")
    ]
    cases += [
        replace(
            base,
            name=f"offset 1e+12, optimal, {samples} samples",
            offset=1e12,
            samples=samples * 10,
            settings={"proposal": "optimal"},
        )
        for samples in (16, 100)
    ]
    single = _wave_case("", 1.0, dtype=torch.float32)
    return [
        *cases,
        replace(single, name="offset 1e12, float32 x", offset=1e12),
        replace(single, name="offset 1e4, float32 x and f", offset=1e4, single_values=True),
    ]


def tilted_axes(n: int, decades: int) -> tuple[Tensor, Tensor]:
    """Return eigenvalues [n] from 1 to 10^-decades, and eigenvectors [n, n], in no way aligned with the axes."""
    w = torch.nn.functional.normalize(torch.arange(1.0, n + 1, dtype=torch.float64), dim=0)
    reflection = torch.eye(n, dtype=torch.float64) - 2 * torch.outer(w, w)
    return torch.logspace(0, -decades, n, dtype=torch.float64), reflection


def _conditioning() -> list[Case]:
    cases = []
    for decades in (0, 6, 12):
        for n in (2, 10):
            spectrum, reflection = tilted_axes(n, decades)
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
        replace(
            _wave_case(f"x at {x:.0e} sigma, {str(dtype)[6:]}", 1.0, x, dtype), refused="everything" if refused else ""
        )
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
