"""What "auto" settings choose against rival estimators at equal evaluations, for many numbers of parameters.

Rivals are restated in a few lines each, so that the study depends on none of their packages:

| name | formula of the gradient | is |
|---|---|---|
| optax | mean of (f(x + sigma u) - f(x)) u / sigma | `optax.perturbations.make_perturbed_fun`, normal |
| EvoTorch, single | mean of (f - mean of all f) u / sigma | `SeparableGaussian` (SNES), raw fitness |
| EvoTorch, pairs | mean of (f(x + sigma u) - f(x - sigma u)) u / (2 sigma) | `SymmetricSeparableGaussian` (PGPE), raw |
| source | mean of f u / (sigma r), u of the mean of all lobes of an order, in pairs | Wang, Fischer and Ritschel 2025 |

"EvoTorch, single" is a factor (K - 1) / K too short, because every value enters its own baseline. Where errors are as
large as the gradient, that shrinkage alone lowers them. All others are unbiased. r is the density that the source draws
u from over the normal one: the mean of the n lobes of the gradient, or of the n^2 lobes of the Hessian, without the
Gaussian share of our mixture. The Hessian-vector product of optax is the second derivative of the same expression.
EvoTorch has none.

The rules of `torch_zerohess.choice` were chosen on six functions. Two more, a product of sines and a steep ridge, are
held out: no rule was chosen on them.

Errors are relative root-mean-square errors over independent runs. f(x) counts as an evaluation wherever a method uses
it.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.closed_forms import PlaneWave, Quadratic, Step
from experiments.reports.progress import progress
from torch_zerohess.sampling.quantiles import gradient_lobe_quantile, hessian_lobe_quantile

Function = Callable[[Tensor], Tensor]
RIVALS = ("default", "optax", "EvoTorch, single", "EvoTorch, pairs", "source")
SIZES = (1, 2, 3, 10, 30, 100, 1024)
BUDGETS = (4, 8, 16, 32, 64, 128, 256, 512)
_MOST_NUMBERS = 2_000_000  # of all perturbations of one setting
_NOISE = 0.4


@dataclass(frozen=True)
class Row:
    """Relative errors at one number of parameters and evaluations."""

    function: str
    quantity: str
    n: int
    budget: int
    chosen: str
    errors: dict[str, float]
    """By method; "auto" is ours."""
    held_out: bool = False
    """Whether no rule of "auto" was chosen on the function."""

    @property
    def best_rival(self) -> str:
        """Which of the others has the least error."""
        return min((name for name in self.errors if name != "auto"), key=self.errors.__getitem__)

    @property
    def ratio(self) -> float:
        """Error of "auto" / least error of the others."""
        return self.errors["auto"] / self.errors[self.best_rival]


@dataclass(frozen=True)
class Case:
    """A function around x = 0 with sigma = 1, and its true smoothed value and derivatives there."""

    name: str
    fn: Function
    gradient: Tensor
    hessian: Tensor
    held_out: bool = False


def compare(
    *, sizes: tuple[int, ...] = SIZES, budgets: tuple[int, ...] = BUDGETS, runs: int = 100, seed: int = 0
) -> list[Row]:
    """Measure gradients (of order 1) and Hessian-vector products.

    Args:
        sizes: numbers of parameters.
        budgets: evaluations of one estimate, at most.
        runs: independent estimates, fewer where n times the budget is large.
        seed: of the noise.
    """
    rows = []
    for n in progress(sizes, "sizes"):
        cases = cases_of(n)
        for budget in budgets:
            count = max(8, min(runs, _MOST_NUMBERS // (n * budget)))
            for quantity in ("gradient", "hvp"):
                rows += _rows(cases, quantity, n, budget, count, seed)
    return rows


def cases_of(n: int) -> list[Case]:
    """Nearly linear, curved, bowl, step, noise, a plateau with narrow valleys as of a rendered loss; two held out."""
    generator = torch.Generator().manual_seed(n)
    k = torch.nn.functional.normalize(torch.randn(n, generator=generator, dtype=torch.float64), dim=0)
    x, sigma = torch.zeros_like(k), torch.ones_like(k)
    spectrum = torch.logspace(0, -2, n, dtype=torch.float64) if n > 1 else torch.ones_like(k)

    def noisy(z: Tensor) -> Tensor:
        y = PlaneWave(0.5 * k, phase=2.5)(z)
        return y + _NOISE * torch.randn(y.shape, generator=generator, dtype=torch.float64)

    forms = [
        ("nearly linear", PlaneWave(0.2 * k, phase=2.5)),
        ("wave", PlaneWave(k, phase=2.5)),
        ("bowl", Quadratic(torch.diag(spectrum), spectrum)),
        ("step", Step(k, 0.3)),
    ]
    cases = [Case(name, form, form.gradient(x, sigma), form.hessian(x, sigma)) for name, form in forms]
    wave = PlaneWave(0.5 * k, phase=2.5)
    cases.append(Case("noisy", noisy, wave.gradient(x, sigma), wave.hessian(x, sigma)))
    # 1 - mean over parameters of exp(-(z - 1)^2 / (2 w^2)), w = 1/2: a convolution of bumps of one parameter
    wide = 1.0 + 0.25
    height = 0.5 / math.sqrt(wide) * math.exp(-0.5 / wide) / n
    slope, curvature = torch.full_like(k, -height / wide), -height * (1 / wide - 1) / wide
    valleys = Case("valleys", _valleys, slope, torch.diag(torch.full_like(k, curvature)))
    a = torch.nn.functional.normalize(torch.randn(n, generator=generator, dtype=torch.float64), dim=0)
    return [*cases, valleys, _product_of_sines(n), _ridge(a)]


def _product_of_sines(n: int) -> Case:
    """Prod sin((z_i + 1) / sqrt(n) + pi / 2): under the convolution each factor shrinks by exp(-1 / (2 n))."""
    w = 1 / math.sqrt(n)
    value, slope = (-0.5 + n * math.log(math.cos(w))), -w * math.tan(w)  # of the logarithm
    gradient = torch.full((n,), math.exp(value) * slope, dtype=torch.float64)
    hessian = torch.full((n, n), math.exp(value) * slope**2, dtype=torch.float64)
    hessian.fill_diagonal_(-math.exp(value) * w**2)
    return Case("product of sines", lambda z: torch.sin(w * (z + 1) + math.pi / 2).prod(-1), gradient, hessian, True)


def _ridge(a: Tensor) -> Case:
    """tanh(5 a . z + 1/2) for a direction a [n]; its derivatives by the trapezoid rule along a."""
    t = torch.linspace(-9, 9, 20_001, dtype=torch.float64)
    weighted = torch.tanh(5 * t + 0.5) * torch.exp(-0.5 * t * t) / math.sqrt(2 * math.pi)
    slope, curvature = (torch.trapezoid(weighted * kernel, t) for kernel in (t, t * t - 1))
    return Case("ridge", lambda z: torch.tanh(5 * (z @ a) + 0.5), slope * a, curvature * torch.outer(a, a), True)


def _valleys(z: Tensor) -> Tensor:
    return 1.0 - torch.exp(-2.0 * (z - 1.0) ** 2).mean(-1)


def _rows(cases: list[Case], quantity: str, n: int, budget: int, runs: int, seed: int) -> list[Row]:
    v = torch.nn.functional.normalize(torch.arange(1.0, n + 1, dtype=torch.float64), dim=0)
    order = 1 if quantity == "gradient" else 2
    auto = zh.Smoothing.auto(sigma=1.0, samples=budget // 2, order=order, seed=seed)
    if auto.resolved(n).baseline == "center":
        auto = auto.replace(samples=max(1, (budget - 1) // 2))
    default = zh.Smoothing(sigma=1.0, samples=max(1, (budget - 1) // 2), order=order, seed=seed)
    generator = torch.Generator().manual_seed(seed + 1)
    u = torch.randn(runs, budget, n, generator=generator, dtype=torch.float64)
    lobes = draws_of_the_source(runs, budget // 2, n, order, generator)
    found = []
    for case in cases:
        truth = case.gradient if quantity == "gradient" else case.hessian @ v
        size = truth.norm() if quantity == "gradient" else case.hessian.norm() / math.sqrt(n)
        methods = {"auto": auto, "default": default}
        estimates = {name: _ours(case.fn, one, n, runs, quantity, v) for name, one in methods.items()}
        rivals = rival_gradients(case.fn, u) if quantity == "gradient" else {"optax": optax_product(case.fn, u, v)}
        rivals["source"] = of_the_source(case.fn, *lobes, None if quantity == "gradient" else v)
        errors = {
            name: float((one - truth).square().sum(1).mean().sqrt() / size)
            for name, one in (estimates | rivals).items()
        }
        found.append(Row(case.name, quantity, n, budget, auto.resolved(n).sampling, errors, case.held_out))
    return found


def _ours(fn: Function, smoothing: zh.Smoothing, n: int, runs: int, quantity: str, v: Tensor) -> Tensor:
    x = torch.zeros(runs, n, dtype=torch.float64)
    result = zh.estimate(fn, x, smoothing, value="smoothed")
    return result.gradient if quantity == "gradient" else result.hvp(v)


def rival_gradients(fn: Function, u: Tensor) -> dict[str, Tensor]:
    """Return gradients [R, n] at x = 0 with sigma = 1 of each rival from R runs of K evaluations, noise u [R, K, n]."""
    R, K, n = u.shape
    zero = torch.zeros(R, n, dtype=u.dtype)
    single, pairs = u[:, : K - 1], u[:, : K // 2]
    f = fn(u.flatten(0, 1)).view(R, K)
    change = f[:, : K - 1] - fn(zero)[:, None]
    difference = 0.5 * (f[:, : K // 2] - fn(-pairs.flatten(0, 1)).view(R, -1))
    return {
        "optax": (change[..., None] * single).mean(1),
        "EvoTorch, single": ((f - f.mean(1, keepdim=True))[..., None] * u).mean(1),
        "EvoTorch, pairs": (difference[..., None] * pairs).mean(1),
    }


def optax_product(fn: Function, u: Tensor, v: Tensor) -> Tensor:
    """Return Hessian-vector products [R, n]: mean of (f(u) - f(0)) (u (u . v) - v)."""
    u = u[:, :-1]
    f = fn(u.flatten(0, 1)).view(u.shape[:2]) - fn(torch.zeros_like(u[:, 0]))[:, None]
    return (f[..., None] * (u * (u @ v)[..., None] - v)).mean(1)


def draws_of_the_source(R: int, S: int, n: int, order: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Return u [R, S, n] of the mixture of all lobes of one order, and its density over the normal one [R, S]."""
    u = torch.randn(R, S, n, generator=generator, dtype=torch.float64)
    i, j = torch.randint(n, (2, R, S, 1), generator=generator)
    p, q = torch.rand(2, R, S, 1, generator=generator, dtype=torch.float64).clamp_min(2.0**-60)
    ends = gradient_lobe_quantile(p)
    if order == 1:
        u.scatter_(2, i, ends)
        return u, math.sqrt(math.pi / 2) * u.abs().mean(2)
    u.scatter_(2, j, gradient_lobe_quantile(q))
    u.scatter_(2, i, torch.where(i == j, hessian_lobe_quantile(p), ends))
    cross = math.pi / 2 * (u.abs().sum(2) ** 2 - u.square().sum(2))
    return u, (cross + math.sqrt(2 * math.pi * math.e) / 4 * (u.square() - 1).abs().sum(2)) / n**2


def of_the_source(fn: Function, u: Tensor, ratio: Tensor, v: Tensor | None) -> Tensor:
    """Return gradients [R, n] at x = 0 with sigma = 1, or products with v [n], from `draws_of_the_source` and -u."""
    plus, minus = (fn(one.flatten(0, 1)).view(ratio.shape) / ratio for one in (u, -u))
    if v is None:
        return (0.5 * (plus - minus)[..., None] * u).mean(1)
    return (0.5 * (plus + minus)[..., None] * (u * (u @ v)[..., None] - v)).mean(1)


def summary(rows: list[Row]) -> tuple[list[str], list[list[object]]]:
    """Return headers and a row per quantity, n, budget and kind of function: geometric means, and the worst function.

    A ratio below 1 says that "auto" has the least error.
    """
    groups: dict[tuple[str, int, int, str], list[Row]] = {}
    for row in rows:
        kind = "held out" if row.held_out else "of the rules"
        groups.setdefault((row.quantity, row.n, row.budget, kind), []).append(row)
    body: list[list[object]] = []
    for (quantity, n, budget, kind), same in groups.items():
        names = [name for name in ("auto", *RIVALS) if name in same[0].errors]
        means = {name: math.exp(sum(math.log(row.errors[name]) for row in same) / len(same)) for name in names}
        worst = max(same, key=lambda row: row.ratio)
        cells = [means.get(name) for name in ("auto", *RIVALS)]
        where = f"{worst.function}, {worst.best_rival}"
        body.append([quantity, n, budget, kind, same[0].chosen, *cells, worst.ratio, where])
    return ["quantity", "n", "evaluations", "functions", "chosen", "auto", *RIVALS, "largest ratio", "where"], body
