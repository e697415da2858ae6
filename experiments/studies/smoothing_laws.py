"""Why the smoothing is Gaussian: errors with noise uniform in a ball, and with Student's t, at equal evaluations.

A law p(u) smooths f to F(x) = E f(x + u). All laws have the covariance I. Derivatives need f alone:

| law | gradient: mean of f(u) s(u) | Hessian: mean of f(u) K(u) |
|---|---|---|
| gaussian | s = u | K = u u^T - I |
| student, nu degrees | s = -grad log p = (nu + n) u / (nu - 2 + u.u) | K = s s^T - ds/du |
| ball, radius R = sqrt(n + 2) | u on the sphere, s = n u / R^2 (divergence theorem) | none: p has an edge |

Three rows more are of the Gaussian: twice as wide, which sees as far as heavy tails do, and `Smoothing.auto` of either
width, which samples it otherwise. All others draw independent pairs; Hessians have the mean of the other pairs as
baseline.

Functions are phi(k . z), k a direction, so that every truth is an integral over one line, by the trapezoid rule: a wave
sin(t + 2.5), a step at 0.3, a far step at 4, a bowl t^2 / 2 + t, and the wave with outliers: one value in twenty has
noise of standard deviation 5. Errors are relative root-mean-square errors against the law's own F. "bias" is the
distance of the gradient of F from the gradient of f at x, over the latter, where f has one.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.reports.progress import progress
from experiments.reports.result_files import keep, may_keep
from experiments.reports.tables import table

SIZES = (2, 10, 100)
_OUTLIERS, _NOISE = 0.05, 5.0
_FAR, _NODES = 400.0, 800_001  # of the trapezoid rule
_MOST_ELEMENTS = 4_000_000  # of all Hessians of one setting
HEADERS = ["law", "n", "function", "evaluations", "gradient", "Hessian", "bias"]


@dataclass(frozen=True)
class Law:
    """A law with covariance width^2 I: Gaussian, uniform in a ball, or Student's with nu degrees of freedom."""

    name: str
    width: float = 1.0
    nu: int | None = None
    ball: bool = False
    auto: bool = False
    """Whether `Smoothing.auto` samples it."""

    def marginal(self, t: Tensor, n: int) -> Tensor:
        """Return the density of one coordinate of u."""
        if self.ball:
            R2 = n + 2.0
            log_c = math.lgamma(n / 2 + 1) - math.lgamma((n + 1) / 2) - 0.5 * math.log(math.pi * R2)
            return math.exp(log_c) * (t * t < R2) * (1 - t * t / R2).clamp_min(0.0) ** ((n - 1) / 2)
        if self.nu is not None:
            log_c = math.lgamma((self.nu + 1) / 2) - math.lgamma(self.nu / 2) - 0.5 * math.log(math.pi * (self.nu - 2))
            return math.exp(log_c) * (1 + t * t / (self.nu - 2)) ** (-(self.nu + 1) / 2)
        return torch.exp(-0.5 * (t / self.width) ** 2) / (self.width * math.sqrt(2 * math.pi))

    def draw(self, shape: tuple[int, ...], generator: torch.Generator) -> Tensor:
        """Return u; on the sphere for the ball."""
        u = torch.randn(shape, generator=generator, dtype=torch.float64)
        if self.ball:
            return torch.nn.functional.normalize(u, dim=-1) * math.sqrt(shape[-1] + 2)
        if self.nu is None:
            return self.width * u
        chi = (
            torch.randn((*shape[:-1], self.nu), generator=generator, dtype=torch.float64).square().sum(-1, keepdim=True)
        )
        return u * ((self.nu - 2) / chi).sqrt()

    def score(self, u: Tensor) -> Tensor:
        """Return s(u)."""
        n = u.shape[-1]
        if self.ball:
            return u * (n / (n + 2))
        return u / self.width**2 if self.nu is None else u * self._scale(u)[..., None]

    def second(self, weights: Tensor, u: Tensor) -> Tensor:
        """Return the mean over draws of weights [R, S] times K(u), [R, n, n], for u [R, S, n]."""
        identity, S = torch.eye(u.shape[2], dtype=u.dtype), u.shape[1]
        if self.nu is None:
            outer, shift = weights / self.width**4, weights / self.width**2
        else:
            shift = weights * self._scale(u)
            outer = shift * self._scale(u) * (1 + 2 / (self.nu + u.shape[2]))
        return (outer[..., None] * u).mT @ u / S - shift.mean(1)[:, None, None] * identity

    def _scale(self, u: Tensor) -> Tensor:
        assert self.nu is not None
        return (self.nu + u.shape[-1]) / (self.nu - 2 + u.square().sum(-1))


LAWS = (
    Law("gaussian"),
    Law("student, nu = 5", nu=5),
    Law("student, nu = 3", nu=3),
    Law("ball", ball=True),
    Law("gaussian, twice as wide", width=2.0),
    Law("gaussian, auto", auto=True),
    Law("gaussian, twice as wide, auto", width=2.0, auto=True),
)


@dataclass(frozen=True)
class Profile:
    """phi along one direction, and its first two derivatives; a step, at `step`, has none."""

    name: str
    phi: Callable[[Tensor], Tensor]
    derivatives: tuple[Callable[[Tensor], Tensor], Callable[[Tensor], Tensor]] | None
    step: float = 0.0
    noisy: bool = False

    def truth(self, law: Law, n: int) -> tuple[float, float]:
        """Return first and second derivative of the smoothed function along the direction."""
        if self.derivatives is None:
            h = 1e-4
            at = law.marginal(torch.tensor([self.step - h, self.step, self.step + h], dtype=torch.float64), n)
            return float(at[1]), float(at[0] - at[2]) / (2 * h)
        t = torch.linspace(-_FAR, _FAR, _NODES, dtype=torch.float64)
        first, second = (float(torch.trapezoid(one(t) * law.marginal(t, n), t)) for one in self.derivatives)
        return first, second


def _wave(t: Tensor) -> Tensor:
    return torch.sin(t + 2.5)


_OF_WAVE = (lambda t: torch.cos(t + 2.5), lambda t: -torch.sin(t + 2.5))
PROFILES = (
    Profile("wave", _wave, _OF_WAVE),
    Profile("step", lambda t: (t > 0.3).double(), None, 0.3),
    Profile("far step", lambda t: (t > 4.0).double(), None, 4.0),
    Profile("bowl", lambda t: 0.5 * t * t + t, (lambda t: t + 1.0, torch.ones_like)),
    Profile("outliers", _wave, _OF_WAVE, noisy=True),
)


def smoothing_laws(
    *,
    sizes: tuple[int, ...] = SIZES,
    evaluations: int = 64,
    runs: int = 2000,
    seed: int = 0,
    store: str | None = None,
) -> list[list[object]]:
    """Measure the errors of gradients and Hessians with each law.

    Args:
        sizes: numbers of parameters.
        evaluations: of one estimate, in pairs.
        runs: independent estimates, fewer where Hessians are large.
        seed: of the noise.
        store: name of the table that is kept under experiments/results, for the documents.
    """
    for name, value, least in (("sizes", min(sizes, default=0), 1), ("evaluations", evaluations, 4), ("runs", runs, 2)):
        if value < least:
            raise SystemExit(f"{name} must be at least {least}, got {value}")
    if evaluations % 2:
        raise SystemExit(f"evaluations must be even, got {evaluations}")
    may_keep(store)
    rows = [
        row_of(law, n, profile, evaluations, runs, seed)
        for n in progress(sizes, "sizes")
        for profile in PROFILES
        for law in LAWS
    ]
    print(f"Relative errors of {evaluations} evaluations, by the law of the noise\n\n{table(HEADERS, rows)}")
    if store is not None:
        kept: Path = keep(HEADERS, rows, store)
        print(kept)
    return rows


def row_of(law: Law, n: int, profile: Profile, evaluations: int, runs: int, seed: int) -> list[object]:
    """Return a row of the table."""
    generator = torch.Generator().manual_seed(seed)
    k = torch.nn.functional.normalize(torch.arange(1.0, n + 1, dtype=torch.float64), dim=0)

    def fn(z: Tensor) -> Tensor:
        y = profile.phi(z @ k)
        if not profile.noisy:
            return y
        hit = torch.rand(y.shape, generator=generator, dtype=torch.float64) < _OUTLIERS
        return y + _NOISE * hit * torch.randn(y.shape, generator=generator, dtype=torch.float64)

    first, second = profile.truth(law, n)
    count = max(20, min(runs, _MOST_ELEMENTS // n**2))
    hessian: Tensor | None
    if law.auto:
        gradient, hessian = _by_auto(law, fn, n, evaluations, count, seed)
    else:
        u = law.draw((count, evaluations // 2, n), generator)
        plus, minus = (fn(one.flatten(0, 1)).view(u.shape[:2]) for one in (u, -u))
        gradient = (0.5 * (plus - minus)[..., None] * law.score(u)).mean(1)
        even = 0.5 * (plus + minus)
        others = (even.sum(1, keepdim=True) - even) / (evaluations // 2 - 1)
        hessian = None if law.ball else law.second(even - others, u)
    bias = None
    if profile.derivatives is not None:
        own = float(profile.derivatives[0](torch.zeros((), dtype=torch.float64)))
        bias = round(abs(first - own) / abs(own), 4)
    errors = [_error(gradient, first * k), None if hessian is None else _error(hessian, second * torch.outer(k, k))]
    return [law.name, n, profile.name, evaluations, *errors, bias]


def _by_auto(
    law: Law, fn: Callable[[Tensor], Tensor], n: int, evaluations: int, count: int, seed: int
) -> tuple[Tensor, Tensor]:
    x = torch.zeros(count, n, dtype=torch.float64)
    auto = zh.Smoothing.auto(sigma=law.width, samples=evaluations // 2, seed=seed)
    first, second = (zh.estimate(fn, x, auto.replace(order=order), value="smoothed") for order in (1, 2))
    return first.gradient, second.hessian()


def _error(found: Tensor, truth: Tensor) -> float | None:
    """Return the relative error; None where the truth is zero: a ball does not reach the far step."""
    size = float(truth.norm())
    return float((found - truth).flatten(1).square().sum(1).mean().sqrt()) / size if size > 0 else None
