"""`python -m experiments least_squares`: our search and others on the least-squares problems of More and Wild.

A problem has a start x0. A method solves it to tau once a point has f <= f_L + tau (f(x0) - f_L), where f_L is the
lowest value that any of the methods finds from x0 (More and Wild 2009). The table has the share of problems solved
after 3, 10 and 100 (n + 1) evaluations. There are 53 from the start of the authors, which is run 0, and as many from
each further start. All methods have the same starts and no bounds. The first step of the others is a tenth of the
largest parameter, at least 0.1, the default of DFO-LS and Py-BOBYQA. A method that ends by itself starts again from a
random point. No method is told of noise.

Noise and oscillations are not in the values that are compared: what counts is where the points are.

`--over` compares settings of a method; use other runs than the tables for that.
"""

import itertools
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast, get_args

import torch
from torch import Tensor

from experiments.ensembles.kept_parts import KeptParts
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.ours import search
from experiments.methods.settings.rivals import ON_MORE_WILD
from experiments.problems import more_wild
from experiments.problems.catalogue import chosen
from experiments.problems.task import Task
from experiments.reports import data_profiles
from experiments.reports.progress import progress
from experiments.reports.result_files import may_keep
from experiments.reports.tables import grouped
from experiments.studies.benchmark_suite import Settings, Suite, row_name, solve

OURS = Method("ours", "TrustRegion with its defaults", with_settings(search), uses="image")
_SIGMA = 3.0
"""First sigma of ours over the first step of the others; best of 1, 3 and 10 on run 1000."""
RIVALS = ("dfo_ls", "cobyqa", "py_bobyqa", "bfgs_fd", "cma_es")
BUDGETS = (3, 10, 100)
"""Evaluations over n + 1 after which the table counts."""
TAUS = (1e-3, 1e-5)
HEADERS = (
    *("kind", "method", "uses"),
    *(f"{tau:.0e}: {budget} (n + 1)" for tau in TAUS for budget in BUDGETS),
    *("ms per evaluation", "problems"),
)
SUITE = Suite(OURS, RIVALS, ON_MORE_WILD, HEADERS, "problems solved", "(n + 1)")


@dataclass(frozen=True)
class Job:
    """One method on one problem."""

    problem: str
    kind: more_wild.Kind
    method: str
    budget: int
    """Evaluations over n + 1."""
    run: int = 0
    """Number of the start."""
    settings: Settings = ()


@dataclass(frozen=True)
class Progression:
    """Every evaluation with a lower value than all before, without noise."""

    first: float
    """Value at the start of the task, which a method need not evaluate."""
    evaluations: Sequence[int]
    values: Sequence[float]
    seconds: float
    """Of the processor."""
    used: int
    """All evaluations."""

    def solved(self, value: float) -> float:
        """Return after how many evaluations a value was at most this; infinite if never."""
        return next((count for count, one in zip(self.evaluations, self.values, strict=True) if one <= value), math.inf)


def least_squares(
    *,
    kinds: tuple[more_wild.Kind, ...] = ("smooth",),
    methods: str = "all",
    problems: tuple[str, ...] = (),
    budget: int = BUDGETS[-1],
    limit: float = 600.0,
    run: int = 0,
    runs: int = 1,
    over: tuple[str, ...] = (),
    out: Path = Path("results/least_squares"),
    store: str | None = None,
) -> None:
    """Print and draw shares of problems solved; called again it goes on where it was.

    Args:
        kinds: smooth, with known residuals; or noisy, wild, nondifferentiable, where the loss alone is known.
        methods: names separated by commas, or all that apply: ours, dfo_ls, cobyqa, py_bobyqa, bfgs_fd, cma_es; or any
            other, see `list`.
        problems: names, as watson_n6 or watson_n6_far; all 53 if not given.
        budget: evaluations over n + 1 that a run may use.
        limit: seconds that a run may take.
        run: number of the first start; 0 is the start of the authors, others are random.
        runs: starts of every problem.
        over: settings of the one method in `methods` to compare, each with a row: `scale=0.3,1,3`.
        out: folder; runs that the same code has made there are not made again.
        store: name under which the table is kept for the documents, as experiments/results/NAME.csv.
    """
    if budget < 1 or run < 0 or runs < 1 or not limit > 0:
        raise SystemExit(
            f"budget and runs must be at least 1, run 0, limit positive, got {budget}, {runs}, {run} and {limit:g}"
        )
    may_keep(store)
    torch.set_num_threads(1)
    there = {one.name: one for one in more_wild.PROBLEMS}
    names = chosen("problems", problems or tuple(there), list(there))
    wanted_kinds = cast("list[more_wild.Kind]", chosen("kinds", kinds, list(get_args(more_wild.Kind))))
    wanted = SUITE.wanted(methods, over)
    parts, done = KeptParts(out), dict[Job, Progression]()
    wanted_runs = list(itertools.product(range(run, run + runs), wanted_kinds, names, wanted))
    for start, kind, name, (method, settings) in progress(wanted_runs, "runs"):
        problem, job = there[name], Job(name, kind, method, budget, start, settings)
        task = more_wild.task(problem, budget * (problem.n + 1), kind)
        if SUITE.method(method).unusable(task) is None:
            make = partial(_run, job, task, limit)
            (done[job],) = parts.rows(asdict(job) | {"limit": limit}, Progression, make)
    if not done:
        raise SystemExit(
            f"methods must have one that applies to {', '.join(kinds)}, got {', '.join(name for name, _ in wanted)}"
        )
    SUITE.conclude(list(rows(done)), profiles(done), budget, out, store)


def _run(job: Job, task: Task, limit: float) -> list[Progression]:
    return [descent(task, SUITE.method(job.method), limit, job.run, dict(job.settings))]


def descent(
    task: Task, method: Method, limit: float = 600.0, run: int = 0, settings: Mapping[str, Any] | None = None
) -> Progression:
    """Run a method from a start of a task until its evaluations are used up. SystemExit if the method fails."""
    seen: list[Tensor] = []

    def loss(x: Tensor) -> Tensor:
        seen.extend(x)
        return task.loss(x)

    def image(x: Tensor) -> Tensor:
        seen.extend(x)
        assert task.output is not None
        return task.output.image(x)

    counted = replace(task, loss=loss, output=None if task.output is None else replace(task.output, image=image))
    if method is OURS:
        settings = {"sigma": _SIGMA * task.sigma, **(settings or {})}
    outcome = solve(counted, method, run, limit, settings)
    error, found = task.truth.image_error, list[tuple[int, float]]()
    for count, point in enumerate(seen, 1):
        value = error(point)
        if not found or value < found[-1][1]:
            found.append((count, value))
    counts, values = zip(*found, strict=True)
    return Progression(error(task.start(run)), counts, values, outcome.seconds, len(seen))


def rows(done: Mapping[Job, Progression]) -> Iterator[list[object]]:
    """Yield a row per kind and method; None for more evaluations than the runs could use."""
    most = min(job.budget for job in done)
    for (kind, name), group in grouped(done.items(), _row).items():
        counts = _solved(group, _lowest(done))
        shares = [
            sum(count <= budget for count in counts[tau]) / len(group) if budget <= most else None
            for tau in TAUS
            for budget in BUDGETS
        ]
        uses = SUITE.method(group[0][0].method).uses if kind == "smooth" else "loss"
        milliseconds = 1e3 * sum(one.seconds for _, one in group) / sum(one.used for _, one in group)
        yield [kind, name, uses, *shares, milliseconds, len(group)]


def profiles(done: Mapping[Job, Progression]) -> dict[str, dict[str, data_profiles.Profile]]:
    """Return, by kind with tau and by method, evaluations over n + 1 until problems are solved, and their number."""
    found: dict[str, dict[str, data_profiles.Profile]] = defaultdict(dict)
    for (kind, name), group in grouped(done.items(), _row).items():
        for tau, counts in _solved(group, _lowest(done)).items():
            found[f"{kind}, tau = {tau:.0e}"][name] = [one for one in counts if math.isfinite(one)], len(counts)
    return found


def _row(run: tuple[Job, Progression]) -> tuple[str, str]:
    """Return the kind and the name of the row of a run."""
    return run[0].kind, row_name(run[0].method, run[0].settings)


def _lowest(done: Mapping[Job, Progression]) -> dict[tuple[str, str, int], float]:
    """Return the lowest value of any method by kind, problem and start."""
    lowest: dict[tuple[str, str, int], float] = defaultdict(lambda: math.inf)
    for job, one in done.items():
        key = job.kind, job.problem, job.run
        lowest[key] = min(lowest[key], one.first, *one.values)
    return lowest


def _solved(
    group: Sequence[tuple[Job, Progression]], lowest: Mapping[tuple[str, str, int], float]
) -> dict[float, list[float]]:
    """Return by tau the evaluations over n + 1 until each problem is solved."""
    sizes, found = {one.name: one.n for one in more_wild.PROBLEMS}, {tau: list[float]() for tau in TAUS}
    for job, one in group:
        low = lowest[job.kind, job.problem, job.run]
        for tau, counts in found.items():
            counts.append(one.solved(low + tau * (one.first - low)) / (sizes[job.problem] + 1))
    return found
