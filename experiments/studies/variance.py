"""Error of the estimators against evaluations and seconds: how much variance each choice of sampling leaves.

Relative root-mean-square errors of value, gradient, Hessian and Hessian-vector product over independent runs, on the
BOX tasks, MUG and plane waves. The truth is closed-form for plane waves and a fine quadrature for MUG. For the BOX
tasks it is a far larger sample of scrambled Sobol points that shares no code with the estimators, and its own standard
error is reported.

The source plots variance against samples per element (its figure 11). A Hessian with a sample set per element then
costs n (n + 1) / 2 times as many evaluations as one with a set for all elements. Both axes are drawn.

Methods with a memory know the evaluations of four earlier estimates of their kind around the same point, 64 each where
that is enough for one. The budget does not count them. On the BOX tasks these are images, not losses.

Methods take turns within every run, so that whatever else the machine does falls on all of them alike.

A second table compares "auto" settings with estimators of other packages, see `estimator_choice`.

At n = 10 uniform sampling does not settle: the few samples near x carry all the weight, up to (10/sqrt(2 pi))^10, and
most runs have none of them.
"""

import json
import math
import statistics
import time
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from experiments.problems.catalogue import chosen
from experiments.reports.progress import progress
from experiments.reports.result_files import keep, may_keep
from experiments.reports.tables import table
from experiments.runs.outputs import check_folder
from experiments.studies.estimator_choice import SIZES, compare, summary
from experiments.studies.estimator_curves import AXES, Measurement, draw
from experiments.studies.estimator_problems import PROBLEMS, QUANTITIES, Function, Problem, made_problem
from experiments.studies.estimators import ALONE, ESTIMATORS, NAMES, OURS, Estimator

_TRUTH_SHARE = 512  # evaluations of the truth per evaluation of the largest budget


@dataclass(frozen=True)
class Ratio:
    """Hessian error of a method of per-element sampling / Hessian error of ours."""

    problem: str
    budget: int
    method: str
    evaluations: int
    ratio: float
    ratio_error: float


@dataclass(frozen=True)
class VarianceReport:
    """Everything `variance` measured."""

    runs: int
    budgets: tuple[int, ...]
    measurements: list[Measurement]
    ratios: list[Ratio]
    truth_error: dict[str, dict[str, float]]


def variance(
    *,
    runs: int = 100,
    seed: int = 0,
    out: Path = Path("results/variance"),
    budgets: tuple[int, ...] = (32, 128, 512, 2048),
    problems: tuple[str, ...] = tuple(PROBLEMS),
    methods: tuple[str, ...] = NAMES,
    side: int = 64,
    sizes: tuple[int, ...] = SIZES,
    rivals: int = 100,
    store: str | None = None,
) -> VarianceReport:
    """Measure the relative RMSE of the estimators against evaluations and seconds, and plot it.

    Args:
        runs: independent estimates per method and budget.
        seed: of everything random.
        out: folder for variance.json, variance_evaluations.png, variance_samples.png and variance_seconds.png.
        budgets: black-box evaluations of one estimate, f(x) included.
        problems: any of box2, box10, mug, wave2 and wave10.
        methods: names of the ways to estimate.
        side: pixels along the image side of the BOX tasks.
        sizes: numbers of parameters of the comparison with other packages, which has the problems, too.
        rivals: its runs; 0 leaves it out.
        store: name of the table that is kept under experiments/results, for the documents; the comparison with other
            packages is kept as NAME_rivals.
    """
    smallest = min(budgets, default=0)
    for argument, value, least in (
        ("runs", runs, 2),
        ("budgets", smallest, 16),
        ("side", side, 1),
        ("seed", seed, 0),
        ("rivals", rivals, 0),
    ):
        if value < least:
            raise SystemExit(f"{argument} must be at least {least}, got {value}")
    may_keep(store)
    names = chosen("problems", [name.upper() for name in problems], list(PROBLEMS))
    known = {method.name: method for method in (*ESTIMATORS, *ALONE)}
    picked = chosen("methods", methods, list(known))
    check_folder(out)
    compared = [method for name, method in known.items() if name in picked]
    made = [made_problem(name, max(budgets) * _TRUTH_SHARE, side, seed) for name in progress(names, "truth")]
    tallies = [_Tally(one, method, budget) for one in made for method in compared for budget in budgets]
    for run in progress(range(runs), "runs"):
        for tally in tallies:
            tally.add((seed << 32) + 1 + run)
    measurements = [measurement for tally in tallies for measurement in tally.measurements()]
    truth_error = {one.name: one.truth_error for one in made}
    report = VarianceReport(runs, tuple(budgets), measurements, _ratios(measurements), truth_error)
    out.mkdir(parents=True, exist_ok=True)
    settings = {"seed": seed, "side": side, "threads": torch.get_num_threads()}
    (out / "variance.json").write_text(json.dumps({**settings, **asdict(report)}, indent=1))
    for against in AXES:
        draw(measurements, made, against, out / f"variance_{against}.png")
    headers, rows = _table(report)
    shown = len(headers) - len(_ERRORS)
    print(f"Relative RMSE of {report.runs} runs\n\n{table(headers[:shown], [row[:shown] for row in rows])}\n")
    _print_checks(report)
    print(f"written to {out}")
    if store is not None:
        print(keep(headers, rows, store))
    if rivals:
        beside = compare(sizes=sizes, runs=rivals, seed=seed, problems=made)
        print(f"\nErrors of auto settings and of other packages, geometric means\n\n{table(*summary(beside))}")
        if store is not None:
            print(keep(*summary(beside), f"{store}_rivals"))
        (out / "rivals.json").write_text(json.dumps([asdict(row) for row in beside], indent=1))
    return report


class _Tally:
    """Squared errors, seconds and evaluations of one method on one problem at one budget, run by run."""

    def __init__(self, problem: Problem, method: Estimator, budget: int) -> None:
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

    def _counted(self, fn: Function) -> Function:
        def counted(points: Tensor) -> Tensor:
            self.evaluations += len(points)
            return fn(points)

        return counted

    def measurements(self) -> list[Measurement]:
        runs, seconds = len(self.seconds), statistics.median(self.seconds)
        found = []
        for name, squares in self.squares.items():
            rmse = math.sqrt(statistics.fmean(squares))
            rmse_error = statistics.stdev(squares) / math.sqrt(runs) / (2 * rmse) if rmse else 0.0
            setting = self.problem.name, self.method.name, self.budget, self.evaluations // runs
            samples = self.method.samples(self.budget, len(self.problem.x))
            found.append(Measurement(*setting, samples, seconds, name, rmse, rmse_error))
        return found


def _ratios(measurements: list[Measurement]) -> list[Ratio]:
    hessian = {(m.problem, m.budget, m.method): m for m in measurements if m.quantity == "hessian"}
    ratios = []
    for (problem, budget, method), theirs in hessian.items():
        if method.startswith("per-element") and ", memory" not in method and (problem, budget, OURS) in hessian:
            ours = hessian[problem, budget, OURS]
            ratio = theirs.rmse / ours.rmse
            spread = ratio * math.hypot(theirs.rmse_error / theirs.rmse, ours.rmse_error / ours.rmse)
            ratios.append(Ratio(problem, budget, method, theirs.evaluations, ratio, spread))
    return ratios


_ERRORS = [f"{quantity}_error" for quantity in QUANTITIES]
"""Columns of the standard errors of the RMSE, in the file alone."""


def _table(report: VarianceReport) -> tuple[list[str], list[list[object]]]:
    """Return headers and rows: a row per problem, method and budget, standard errors last."""
    rows: dict[tuple[str, str, int], dict[str, Measurement]] = {}
    for m in report.measurements:
        rows.setdefault((m.problem, m.method, m.budget), {})[m.quantity] = m
    body: list[list[object]] = [
        [
            problem,
            method,
            budget,
            (one := next(iter(found.values()))).evaluations,
            1e3 * one.seconds,
            *(found[q].rmse if q in found else None for q in QUANTITIES),
            *(found[q].rmse_error if q in found else None for q in QUANTITIES),
        ]
        for (problem, method, budget), found in rows.items()
    ]
    return ["problem", "method", "budget", "evaluations", "ms", *QUANTITIES, *_ERRORS], body


def _print_checks(report: VarianceReport) -> None:
    print("Relative standard error of the truth\n")
    truth = [[name, *errors.values()] for name, errors in report.truth_error.items()]
    print(table(["problem", *QUANTITIES], truth))
    print(f"\nHessian error / Hessian error of {OURS}\n")
    ratios = [[r.problem, r.budget, r.method, r.evaluations, r.ratio, r.ratio_error] for r in report.ratios]
    print(table(["problem", "budget", "method", "evaluations", "ratio", "+-"], ratios))
