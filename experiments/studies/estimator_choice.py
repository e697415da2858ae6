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
Gaussian share of our mixture. Hessian and Hessian-vector product of optax are second derivatives of the same
expression. EvoTorch has none. The draws of the source for the Hessian serve nothing else; those of "auto" serve value
and gradient, too.

The rules of `torch_zerohess.choice` were chosen on six functions. Two more, a product of sines and a steep ridge, are
held out: no rule was chosen on them. Nor was any on losses of images: MUG, from a table of renders, and the BOX tasks.

Errors are relative root-mean-square errors over independent runs. f(x) counts as an evaluation wherever a method uses
it.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.closed_forms import PlaneWave, Quadratic, Step
from experiments.reports.progress import progress
from experiments.reports.tables import grouped
from experiments.studies.estimator_problems import Problem
from torch_zerohess.sampling.quantiles import gradient_lobe_quantile, hessian_lobe_quantile

Function = Callable[[Tensor], Tensor]
RIVALS = ("default", "optax", "EvoTorch, single", "EvoTorch, pairs", "source")
SIZES = (1, 2, 3, 10, 30, 100, 300, 1024)
QUANTITIES = ("gradient", "hvp", "hessian")
BUDGETS = (4, 8, 16, 32, 64, 128, 256, 512)
_MOST_NUMBERS = 2_000_000  # of all perturbations of one setting
_MOST_ELEMENTS = 10_000_000  # of all its Hessians
_POINTS = 2048  # of a problem at a time, each with an image
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
    kind: str = "of the rules"
    """Whether a rule of "auto" was chosen on the function."""

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
    """A function around x = 0 with sigma = 1, and the true derivatives of the smoothed function there."""

    name: str
    fn: Function
    gradient: Tensor
    hessian: Tensor
    kind: str = "of the rules"

    @classmethod
    def of(cls, problem: Problem) -> "Case":
        """Return a problem in units of its sigma."""
        x, sigma, truth = problem.x, problem.sigma, problem.truth

        def fn(u: Tensor) -> Tensor:
            return torch.cat([problem.fn(x + sigma * part) for part in u.split(_POINTS)])

        return cls(problem.name, fn, truth["gradient"] * sigma, truth["hessian"] * sigma**2, problem.name)


def compare(
    *,
    sizes: tuple[int, ...] = SIZES,
    budgets: tuple[int, ...] = BUDGETS,
    runs: int = 100,
    seed: int = 0,
    problems: Sequence[Problem] = (),
) -> list[Row]:
    """Measure gradients (of order 1), Hessian-vector products and Hessians.

    Args:
        sizes: numbers of parameters.
        budgets: evaluations of one estimate, at most.
        runs: independent estimates, fewer where n times the budget, or the Hessian, is large.
        seed: of the noise.
        problems: further functions, each with rows of its own. Plane waves are among the functions already.
    """
    groups = [(n, cases_of(n)) for n in sizes]
    groups += [(len(one.x), [Case.of(one)]) for one in problems if not one.name.startswith("WAVE")]
    rows = []
    for n, cases in progress(groups, "sizes"):
        for budget in budgets:
            count = max(8, min(runs, _MOST_NUMBERS // (n * budget)))
            for quantity in QUANTITIES:
                most = count if quantity != "hessian" else max(8, min(count, _MOST_ELEMENTS // n**2))
                rows += _rows(cases, quantity, n, budget, most, seed)
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
    return Case("product of sines", lambda z: torch.cos(w * (z + 1)).prod(-1), gradient, hessian, "held out")


def _ridge(a: Tensor) -> Case:
    """tanh(5 a . z + 1/2) for a direction a [n]; its derivatives by the trapezoid rule along a."""
    t = torch.linspace(-9, 9, 20_001, dtype=torch.float64)
    weighted = torch.tanh(5 * t + 0.5) * torch.exp(-0.5 * t * t) / math.sqrt(2 * math.pi)
    slope, curvature = (torch.trapezoid(weighted * kernel, t) for kernel in (t, t * t - 1))
    return Case("ridge", lambda z: torch.tanh(5 * (z @ a) + 0.5), slope * a, curvature * torch.outer(a, a), "held out")


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
        truth = {"gradient": case.gradient, "hvp": case.hessian @ v, "hessian": case.hessian}[quantity]
        size = truth.norm() if quantity != "hvp" else case.hessian.norm() / math.sqrt(n)
        methods = {"auto": auto, "default": default}
        estimates = {name: _ours(case.fn, one, n, runs, quantity, v) for name, one in methods.items()}
        vector = v if quantity == "hvp" else None
        if quantity == "gradient":
            rivals = rival_gradients(case.fn, u) | {"source": gradient_of_the_source(case.fn, *lobes)}
        else:
            rivals = {"optax": second_of_optax(case.fn, u, vector)}
            rivals["source"] = second_of_the_source(case.fn, *lobes, vector)
        errors = {
            name: float((one - truth).flatten(1).square().sum(1).mean().sqrt() / size)
            for name, one in (estimates | rivals).items()
        }
        found.append(Row(case.name, quantity, n, budget, auto.resolved(n).sampling, errors, case.kind))
    return found


def _ours(fn: Function, smoothing: zh.Smoothing, n: int, runs: int, quantity: str, v: Tensor) -> Tensor:
    x = torch.zeros(runs, n, dtype=torch.float64)
    result = zh.estimate(fn, x, smoothing, value="smoothed")
    if quantity == "gradient":
        return result.gradient
    return result.hvp(v) if quantity == "hvp" else result.hessian()


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


def second_of_optax(fn: Function, u: Tensor, v: Tensor | None) -> Tensor:
    """Return the mean of (f(u) - f(0)) (u u^T - I), [R, n, n], or its products with v, [R, n]."""
    u = u[:, :-1]
    return _second(fn(u.flatten(0, 1)).view(u.shape[:2]) - fn(torch.zeros_like(u[:, 0]))[:, None], u, v)


def _second(weights: Tensor, u: Tensor, v: Tensor | None) -> Tensor:
    """Return the mean over K of weights [R, K] times (u u^T - I), or times its product with v [n], for u [R, K, n]."""
    if v is not None:
        return (weights[..., None] * (u * (u @ v)[..., None] - v)).mean(1)
    identity = torch.eye(u.shape[2], dtype=u.dtype)
    return (weights[..., None] * u).mT @ u / u.shape[1] - weights.mean(1)[:, None, None] * identity


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


def gradient_of_the_source(fn: Function, u: Tensor, ratio: Tensor) -> Tensor:
    """Return gradients [R, n] at x = 0 with sigma = 1, from `draws_of_the_source` and -u."""
    plus, minus = _over(fn, u, ratio)
    return (0.5 * (plus - minus)[..., None] * u).mean(1)


def second_of_the_source(fn: Function, u: Tensor, ratio: Tensor, v: Tensor | None) -> Tensor:
    """Return Hessians [R, n, n], or their products with v, [R, n], in the same way."""
    plus, minus = _over(fn, u, ratio)
    return _second(0.5 * (plus + minus), u, v)


def _over(fn: Function, u: Tensor, ratio: Tensor) -> tuple[Tensor, Tensor]:
    """Return f(u) and f(-u) over the ratio of the densities, [R, S]."""
    return fn(u.flatten(0, 1)).view(ratio.shape) / ratio, fn(-u.flatten(0, 1)).view(ratio.shape) / ratio


def summary(rows: list[Row]) -> tuple[list[str], list[list[object]]]:
    """Return headers and a row per quantity, n, budget and kind of function: geometric means, and the worst function.

    A ratio below 1 says that "auto" has the least error.
    """
    groups = grouped(rows, lambda row: (row.quantity, row.n, row.budget, row.kind))
    body: list[list[object]] = []
    for (quantity, n, budget, kind), same in groups.items():
        names = [name for name in ("auto", *RIVALS) if name in same[0].errors]
        means = {name: math.exp(sum(math.log(row.errors[name]) for row in same) / len(same)) for name in names}
        worst = max(same, key=lambda row: row.ratio)
        cells = [means.get(name) for name in ("auto", *RIVALS)]
        where = f"{worst.function}, {worst.best_rival}"
        body.append([quantity, n, budget, kind, same[0].chosen, *cells, worst.ratio, where])
    return ["quantity", "n", "evaluations", "functions", "chosen", "auto", *RIVALS, "largest ratio", "where"], body
