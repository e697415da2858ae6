"""Error of the estimators against evaluations and seconds: how much variance each choice of sampling leaves.

Relative root-mean-square errors of value, gradient, Hessian and Hessian-vector product over independent runs, on the
BOX tasks and on a plane wave. The truth is closed-form for the plane wave; for the BOX tasks it is a far larger sample
of scrambled Sobol points that shares no code with the estimators, and its own standard error is reported.

Methods take turns within every run, so that whatever else the machine does falls on all of them alike.

At n = 10 uniform sampling does not settle: the few samples near x carry all the weight, up to (10/sqrt(2 pi))^10, and
most runs have none of them.
"""

import json
import math
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import matplotlib as mpl
import torch
from torch import Tensor
from tqdm import tqdm

import torch_zerohess as zh
from experiments.problems.catalogue import chosen
from experiments.problems.closed_forms import PlaneWave
from experiments.problems.soft_squares import BoxTask, box2, box10
from experiments.reports.tables import table

mpl.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import NullFormatter

Function = Callable[[Tensor], Tensor]
Quantities = dict[str, Tensor]
QUANTITIES = ("value", "gradient", "hessian", "hvp")
PROBLEMS = {"BOX2": 2, "BOX10": 10, "WAVE10": 10}
"""Parameters of each."""
OURS, PAPER = "aggregate + center", "per-element + none"
_TRUTH_SCRAMBLES = 16
_TRUTH_SHARE = 512  # evaluations of the truth per evaluation of the largest budget


@dataclass(frozen=True)
class Problem:
    """A black box, a point, a sigma and what is true there."""

    name: str
    fn: Function
    x: Tensor
    sigma: float
    v: Tensor
    truth: Quantities
    truth_error: dict[str, float]
    """Relative standard error of the truth."""


@dataclass(frozen=True)
class Method:
    """One way to estimate; `difference` takes the HVP by finite differences of gradients instead."""

    name: str
    proposal: Literal["aggregate", "gaussian", "optimal", "uniform"]
    baseline: Literal["center", "mean", "none"]
    sampler: Literal["random", "sobol", "orthogonal"] = "random"
    antithetic: bool = True
    difference: Literal["independent", "common"] | None = None

    def smoothing(self, budget: int, n: int, sigma: float, seed: int) -> zh.Smoothing:
        """Return the settings with the most samples whose evaluations do not exceed the budget, but at least one."""
        settings = zh.Smoothing(
            sigma=sigma,
            samples=2,
            proposal=self.proposal,
            antithetic=self.antithetic,
            baseline=self.baseline,
            sampler=self.sampler,
            seed=seed,
            order=1 if self.difference else 2,
        )
        if self.difference:
            budget //= 2
        each = settings.evaluations(n, center=False) // 2
        return settings.replace(samples=max(1, (budget - (self.baseline == "center")) // each))

    def estimate(self, problem: Problem, fn: Function, budget: int, seed: int) -> Quantities:
        """Return every quantity this method estimates, from one budget of evaluations of fn."""
        smoothing = self.smoothing(budget, len(problem.x), problem.sigma, seed)
        if self.difference:
            common = self.difference == "common"
            return {"hvp": zh.finite_difference_hvp(fn, problem.x, problem.v, smoothing, common=common)}
        result = zh.estimate(fn, problem.x, smoothing, value="smoothed")
        return {
            "value": result.value,
            "gradient": result.gradient,
            "hessian": result.hessian(),
            "hvp": result.hvp(problem.v),
        }


METHODS = (
    Method(OURS, "aggregate", "center"),
    Method("aggregate + center, sobol", "aggregate", "center", sampler="sobol"),
    Method("aggregate + center, orthogonal", "aggregate", "center", sampler="orthogonal"),
    Method("aggregate + mean", "aggregate", "mean"),
    Method("aggregate + none", "aggregate", "none"),
    Method("gaussian + center", "gaussian", "center"),
    Method("gaussian + center, sobol", "gaussian", "center", sampler="sobol"),
    Method("gaussian + center, orthogonal", "gaussian", "center", sampler="orthogonal"),
    Method("gaussian + none", "gaussian", "none"),
    Method(PAPER, "optimal", "none"),
    Method("per-element + none, unpaired", "optimal", "none", antithetic=False),
    Method("per-element + center", "optimal", "center"),
    Method("uniform + none", "uniform", "none"),
    Method("uniform + center", "uniform", "center"),
    Method("differences, independent", "aggregate", "center", difference="independent"),
    Method("differences, common", "aggregate", "center", difference="common"),
)


@dataclass(frozen=True)
class Measurement:
    """Relative RMSE of one quantity, with its own standard error, at the median seconds and evaluations of one run."""

    problem: str
    method: str
    budget: int
    evaluations: int
    seconds: float
    quantity: str
    rmse: float
    rmse_error: float


@dataclass(frozen=True)
class Ratio:
    """How many times larger the Hessian error of a method of per-element sampling is than that of ours."""

    problem: str
    budget: int
    method: str
    evaluations: int
    ratio: float
    ratio_error: float


@dataclass(frozen=True)
class ErrorReport:
    """Everything `error` measured."""

    runs: int
    budgets: tuple[int, ...]
    measurements: list[Measurement]
    ratios: list[Ratio]
    truth_error: dict[str, dict[str, float]]

    def get(self, problem: str, method: str, budget: int, quantity: str) -> Measurement:
        """Return the one measurement of these."""
        wanted = (problem, method, budget, quantity)
        return next(m for m in self.measurements if (m.problem, m.method, m.budget, m.quantity) == wanted)

    def slope(self, problem: str, method: str, quantity: str, *, against: str = "evaluations") -> float:
        """Slope of the straight line through log error over log evaluations or seconds; NaN with fewer than two."""
        return _slope(*_curve(self, problem, method, quantity, against))


def error(
    *,
    runs: int = 100,
    seed: int = 0,
    out: Path = Path("results/error"),
    budgets: tuple[int, ...] = (32, 128, 512, 2048),
    problems: tuple[str, ...] = tuple(PROBLEMS),
    side: int = 64,
) -> ErrorReport:
    """Measure the relative RMSE of the estimators against evaluations and seconds, and plot it.

    Args:
        runs: independent estimates per method and budget.
        seed: of everything random.
        out: folder for error.json, error_evaluations.png and error_seconds.png.
        budgets: black-box evaluations of one estimate, f(x) included.
        problems: any of box2, box10 and wave10.
        side: pixels along the image side of the BOX tasks.
    """
    smallest = min(budgets, default=0)
    for argument, value, least in (("runs", runs, 2), ("budgets", smallest, 16), ("side", side, 1), ("seed", seed, 0)):
        if value < least:
            raise SystemExit(f"{argument} must be at least {least}, got {value}")
    names = chosen("problems", [name.upper() for name in problems], list(PROBLEMS))
    made = [_problem(name, max(budgets) * _TRUTH_SHARE, side, seed) for name in names]
    jobs = [(problem, method, budget) for problem in made for method in METHODS for budget in budgets]
    tallies = [_Tally(problem, method, budget) for problem, method, budget in jobs]
    for run in tqdm(range(runs), desc="error", disable=None):
        for tally in tallies:
            tally.add((seed << 32) + 1 + run)
    measurements = [measurement for tally in tallies for measurement in tally.measurements()]
    truth_error = {problem.name: problem.truth_error for problem in made}
    report = ErrorReport(runs, tuple(budgets), measurements, _ratios(measurements), truth_error)
    out.mkdir(parents=True, exist_ok=True)
    settings = {"seed": seed, "side": side, "threads": torch.get_num_threads()}
    (out / "error.json").write_text(json.dumps({**settings, **asdict(report)}, indent=1))
    for against in ("evaluations", "seconds"):
        _plot(report, made, against, out / f"error_{against}.png")
    _print(report)
    print(f"written to {out}")
    return report


def _problem(name: str, truth_evaluations: int, side: int, seed: int) -> Problem:
    tasks: dict[str, Callable[[int], BoxTask]] = {"BOX2": box2, "BOX10": box10}
    n = PROBLEMS[name]
    generator = torch.Generator().manual_seed(seed)
    v = torch.nn.functional.normalize(torch.randn(n, generator=generator, dtype=torch.float64), dim=0)
    if name in tasks:
        task = tasks[name](side)

        def fn(points: Tensor) -> Tensor:
            return task.loss(points.float()).double()  # single precision is far below the noise, and faster

        truth, errors = _sampled_truth(fn, task.start, task.sigma, v, truth_evaluations, seed)
        return Problem(name, fn, task.start, task.sigma, v, truth, errors)
    sigma = 0.5
    k = torch.nn.functional.normalize(torch.randn(n, generator=generator, dtype=torch.float64), dim=0) / sigma
    x = torch.zeros(n, dtype=torch.float64)
    wave, scale = PlaneWave(k, phase=0.7 + math.pi / 2), torch.full((n,), sigma, dtype=torch.float64)
    hessian = wave.hessian(x, scale)
    truth = {"value": wave.value(x, scale), "gradient": wave.gradient(x, scale), "hessian": hessian}
    truth["hvp"] = hessian @ v
    return Problem(name, wave, x, sigma, v, truth, dict.fromkeys(QUANTITIES, 0.0))


def _sampled_truth(
    fn: Function, x: Tensor, sigma: float, v: Tensor, evaluations: int, seed: int
) -> tuple[Quantities, dict[str, float]]:
    """Stein's identities written out, on antithetic pairs of independently scrambled Sobol points.

    Returns the quantities and their relative standard errors, from the spread of the scrambles.
    """
    count = 2 ** max(8, round(math.log2(evaluations / (2 * _TRUTH_SCRAMBLES))))
    n, center = len(x), fn(x[None])
    estimates: dict[str, list[Tensor]] = {name: [] for name in QUANTITIES}
    for scramble in range(_TRUTH_SCRAMBLES):
        engine = torch.quasirandom.SobolEngine(n, scramble=True, seed=1_000_003 * (seed + 1) + scramble)
        u = torch.special.ndtri(engine.draw(count, dtype=torch.float64) + 2.0**-31)
        plus, minus = fn(x + sigma * u) - center, fn(x - sigma * u) - center
        even, odd = (plus + minus) / 2, (plus - minus) / 2
        hessian = ((u * even[:, None]).mT @ u / count - even.mean() * torch.eye(n, dtype=torch.float64)) / sigma**2
        estimates["value"].append(center[0] + even.mean())
        estimates["gradient"].append(odd @ u / count / sigma)
        estimates["hessian"].append(hessian)
        estimates["hvp"].append(hessian @ v)
    stacked = {name: torch.stack(values) for name, values in estimates.items()}
    truth = {name: values.mean(0) for name, values in stacked.items()}
    errors = {
        name: float((values.std(0) / math.sqrt(_TRUTH_SCRAMBLES)).norm() / truth[name].norm())
        for name, values in stacked.items()
    }
    return truth, errors


class _Tally:
    """Squared errors, seconds and evaluations of one method on one problem at one budget, run by run."""

    def __init__(self, problem: Problem, method: Method, budget: int) -> None:
        self.problem, self.method, self.budget = problem, method, budget
        self.squares: dict[str, list[float]] = {}
        self.seconds: list[float] = []
        self.evaluations = 0

    def add(self, seed: int) -> None:
        start = time.perf_counter()
        result = self.method.estimate(self.problem, self._counted, self.budget, seed)
        self.seconds.append(time.perf_counter() - start)
        for name, value in result.items():
            truth = self.problem.truth[name]
            self.squares.setdefault(name, []).append(float((value - truth).norm() / truth.norm()) ** 2)

    def _counted(self, points: Tensor) -> Tensor:
        self.evaluations += len(points)
        return self.problem.fn(points)

    def measurements(self) -> list[Measurement]:
        runs, seconds = len(self.seconds), statistics.median(self.seconds)
        found = []
        for name, squares in self.squares.items():
            rmse = math.sqrt(statistics.fmean(squares))
            rmse_error = statistics.stdev(squares) / math.sqrt(runs) / (2 * rmse) if rmse else 0.0
            setting = self.problem.name, self.method.name, self.budget, self.evaluations // runs
            found.append(Measurement(*setting, seconds, name, rmse, rmse_error))
        return found


def _ratios(measurements: list[Measurement]) -> list[Ratio]:
    hessian = {(m.problem, m.budget, m.method): m for m in measurements if m.quantity == "hessian"}
    ratios = []
    for (problem, budget, method), theirs in hessian.items():
        if method.startswith("per-element"):
            ours = hessian[problem, budget, OURS]
            ratio = theirs.rmse / ours.rmse
            spread = ratio * math.hypot(theirs.rmse_error / theirs.rmse, ours.rmse_error / ours.rmse)
            ratios.append(Ratio(problem, budget, method, theirs.evaluations, ratio, spread))
    return ratios


def _curve(
    report: ErrorReport, problem: str, method: str, quantity: str, against: str
) -> tuple[list[float], list[float]]:
    """Return evaluations (or seconds) and errors, in order of the budget; each number of evaluations once."""
    chosen = [m for m in report.measurements if (m.problem, m.method, m.quantity) == (problem, method, quantity)]
    once = {m.evaluations: m for m in reversed(chosen)}
    chosen = [m for m in chosen if once[m.evaluations] is m]
    return [float(getattr(m, against)) for m in chosen], [m.rmse for m in chosen]


def _slope(x: Sequence[float], y: Sequence[float]) -> float:
    if len(x) < 2 or min(y) <= 0:
        return math.nan
    a, b = (torch.tensor(values, dtype=torch.float64).log() for values in (x, y))
    a, b = a - a.mean(), b - b.mean()
    return float(a @ b / (a @ a))


def _style(method: Method) -> dict[str, Any]:
    """Colour says where points come from, the line what is subtracted, the marker how points depend on each other."""
    colors = {"aggregate": "#c1272d", "gaussian": "#1f6fb4", "optimal": "#2b2b2b", "uniform": "#e08a1e"}
    lines = {"center": "-", "mean": "--", "none": ":"}
    markers = {"random": "o", "sobol": "s", "orthogonal": "^"}
    style: dict[str, Any] = {
        "color": colors[method.proposal],
        "linestyle": lines[method.baseline],
        "marker": markers[method.sampler] if method.antithetic else "x",
        "markersize": 4,
        "linewidth": 2.6 if method.name == OURS else 1.3,
    }
    if method.difference:
        style |= {"color": "#2e8b57", "marker": "d" if method.difference == "common" else "D"}
        style["linestyle"] = "-" if method.difference == "common" else ":"
    return style


def _plot(report: ErrorReport, problems: list[Problem], against: str, path: Path) -> None:
    titles = {"value": "value", "gradient": "gradient", "hessian": "Hessian", "hvp": "Hessian-vector product"}
    figure, axes = plt.subplots(len(problems), 4, figsize=(22, 6.2 * len(problems)), squeeze=False)
    for row, problem in zip(axes, problems, strict=True):
        for axis, quantity in zip(row, QUANTITIES, strict=True):
            for method in METHODS:
                x, y = _curve(report, problem.name, method.name, quantity, against)
                if x:
                    slope = _slope(x, y)
                    label = method.name if math.isnan(slope) else f"{method.name} ({slope:+.2f})"
                    axis.plot(x, y, label=label, **_style(method))
            axis.set(xscale="log", yscale="log", xlabel=against)
            if against == "evaluations":
                axis.set_xticks(report.budgets, [str(budget) for budget in report.budgets])
            axis.xaxis.set_minor_formatter(NullFormatter())
            axis.yaxis.set_minor_formatter(NullFormatter())
            axis.set_title(f"{problem.name} (n = {len(problem.x)}): {titles[quantity]}")
            axis.axhline(1, color="0.6", linewidth=0.8, zorder=0)
            axis.grid(which="major", color="0.9")
            axis.spines[["top", "right"]].set_visible(False)
            axis.legend(
                fontsize=7, ncols=2, frameon=False, loc="upper center", bbox_to_anchor=(0.5, -0.14), handlelength=3
            )
        row[0].set_ylabel("relative RMSE")
    figure.suptitle(
        f"Error of the estimators against {against} (slope of the log-log fit in parentheses)", fontsize=15, y=0.995
    )
    height = len(problems)  # fixed margins: leaving room for the legends automatically takes ten times as long
    figure.subplots_adjust(0.03, 0.32 / height, 0.99, 1 - 0.13 / height, wspace=0.14, hspace=0.55)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _print(report: ErrorReport) -> None:
    rows: dict[tuple[str, str, int], dict[str, Measurement]] = {}
    for m in report.measurements:
        rows.setdefault((m.problem, m.method, m.budget), {})[m.quantity] = m
    body = [
        [
            problem,
            method,
            budget,
            (one := next(iter(found.values()))).evaluations,
            1e3 * one.seconds,
            *(found[q].rmse if q in found else None for q in QUANTITIES),
        ]
        for (problem, method, budget), found in rows.items()
    ]
    print(f"Relative RMSE of {report.runs} runs\n")
    print(table(["problem", "method", "budget", "evaluations", "ms", *QUANTITIES], body))
    print("\nRelative standard error of the truth\n")
    truth = [[name, *errors.values()] for name, errors in report.truth_error.items()]
    print(table(["problem", *QUANTITIES], truth))
    print(f"\nHessian error relative to that of {OURS}\n")
    ratios = [[r.problem, r.budget, r.method, r.evaluations, r.ratio, r.ratio_error] for r in report.ratios]
    print(table(["problem", "budget", "method", "evaluations", "ratio", "+-"], ratios))
