"""`python -m experiments least_squares`: our search and others on the least-squares problems of More and Wild.

A method solves a problem to tau once a point has f <= f_L + tau (f(x0) - f_L), where f_L is the lowest value that any
of the methods finds (More and Wild 2009). The table has the share of the 53 problems solved after 3, 10 and 100 (n + 1)
evaluations. All methods have the same starts and no bounds. The first step is a tenth of the largest parameter, the
default of DFO-LS and Py-BOBYQA. A method that ends by itself starts again from a random point.

Noise and oscillations are not in the values that are compared: what counts is where the points are.
"""

import itertools
import math
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import get_args

import torch
from torch import Tensor

from experiments.ensembles.kept_parts import KeptParts
from experiments.methods import METHODS
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.ours import search
from experiments.problems import more_wild
from experiments.problems.catalogue import chosen
from experiments.problems.task import Task
from experiments.reports import data_profiles
from experiments.reports.progress import progress
from experiments.reports.result_files import keep, may_keep
from experiments.reports.tables import table
from experiments.runs.attempt import attempt
from experiments.studies.optimizers import again

OURS = Method("ours", "TrustRegion with its defaults", with_settings(search), uses="image")
_SIGMA = 3.0
"""First sigma of ours over the first step of the others; best of 1, 3 and 10 from random starts, which no table has."""
RIVALS = ("dfo_ls", "cobyqa", "py_bobyqa", "bfgs_fd", "cma_es")
BUDGETS = (3, 10, 100)
"""Evaluations over n + 1 after which the table counts."""
TAUS = (1e-3, 1e-5)
HEADERS = (
    *("kind", "method", "uses"),
    *(f"{tau:.0e}: {budget} (n + 1)" for tau in TAUS for budget in BUDGETS),
    *("ms per evaluation", "problems"),
)


@dataclass(frozen=True)
class Job:
    """One method on one problem."""

    problem: str
    kind: more_wild.Kind
    method: str
    budget: int
    """Evaluations over n + 1."""


@dataclass(frozen=True)
class Descent:
    """Every evaluation with a lower value than all before, without noise, from the start on."""

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
        out: folder; runs that the same code has made there are not made again.
        store: name under which the table is kept for the documents, as experiments/results/NAME.csv.
    """
    if budget < 1 or not limit > 0:
        raise SystemExit(f"budget must be at least 1, limit positive, got {budget} and {limit:g}")
    if store is not None:
        may_keep(store)
    torch.set_num_threads(1)
    there = {one.name: one for one in more_wild.PROBLEMS}
    names = chosen("problems", problems or tuple(there), list(there))
    chosen("kinds", kinds, list(get_args(more_wild.Kind)))
    known = {OURS.name: OURS, **METHODS}
    all_methods = (OURS.name, *RIVALS)
    wanted = all_methods if methods.strip() == "all" else chosen("methods", methods.split(","), list(known))
    for name in wanted:
        if known[name].missing():
            raise SystemExit(f"{name} needs pip install {' '.join(known[name].missing())}")
    parts, done = KeptParts(out), dict[Job, Descent]()
    each = itertools.product(kinds, names, wanted)
    for kind, name, method in progress(list(each), "runs"):
        problem, job = there[name], Job(name, kind, method, budget)
        task = more_wild.task(problem, budget * (problem.n + 1), kind)
        if known[method].unusable(task) is None:
            make = partial(_run, task, known[method], limit)
            (done[job],) = parts.rows(asdict(job) | {"limit": limit}, Descent, make)
    found = list(rows(done))
    print(table(HEADERS, found))
    path = out / "profiles.png"
    data_profiles.draw(profiles(done), "(n + 1)", budget, path)
    print(path)
    if store is not None:
        print(keep(HEADERS, found, store))


def _run(task: Task, method: Method, limit: float) -> list[Descent]:
    return [descent(task, method, limit)]


def descent(task: Task, method: Method, limit: float = 600.0) -> Descent:
    """Run a method from the start of a task until its evaluations are used up."""
    found: list[tuple[int, float]] = []
    used = 0

    def seen(points: Tensor) -> None:
        nonlocal used
        for point in points:
            used += 1
            value = task.truth.image_error(point)
            if not found or value < found[-1][1]:
                found.append((used, value))

    def loss(x: Tensor) -> Tensor:
        seen(x)
        return task.loss(x)

    def image(x: Tensor) -> Tensor:
        seen(x)
        assert task.output is not None
        return task.output.image(x)

    output = None if task.output is None else replace(task.output, image=image)
    settings = {"sigma": _SIGMA * task.sigma} if method is OURS else None
    counted, begun = replace(task, loss=loss, output=output), time.process_time()
    attempt(counted, method.name, 0, lambda trial: again(trial, method, settings), limit=limit)
    counts, values = zip(*found, strict=True) if found else ((), ())
    return Descent(counts, values, time.process_time() - begun, used)


def rows(done: Mapping[Job, Descent]) -> Iterator[list[object]]:
    """Yield a row per kind and method; None for more evaluations than the runs could use."""
    known = {OURS.name: OURS, **METHODS}
    for (kind, method), group in _solved(done).items():
        shares = [
            sum(count <= budget for count in group[tau]) / len(group[tau]) if budget <= most else None
            for tau in TAUS
            for budget, most in zip(BUDGETS, itertools.repeat(_budget(done)))
        ]
        runs = [one for job, one in done.items() if (job.kind, job.method) == (kind, method)]
        milliseconds = 1e3 * sum(one.seconds for one in runs) / sum(one.used for one in runs)
        yield [kind, method, known[method].uses if kind == "smooth" else "loss", *shares, milliseconds, len(runs)]


def profiles(done: Mapping[Job, Descent]) -> dict[str, dict[str, data_profiles.Profile]]:
    """Return, by kind with tau and by method, evaluations over n + 1 until problems are solved, and their number."""
    found: dict[str, dict[str, data_profiles.Profile]] = defaultdict(dict)
    for (kind, method), group in _solved(done).items():
        for tau, counts in group.items():
            found[f"{kind}, tau = {tau:.0e}"][method] = [one for one in counts if math.isfinite(one)], len(counts)
    return found


def _budget(done: Mapping[Job, Descent]) -> int:
    return min(job.budget for job in done)


def _solved(done: Mapping[Job, Descent]) -> dict[tuple[str, str], dict[float, list[float]]]:
    """Return, by kind and method, and then by tau, evaluations over n + 1 until each problem is solved."""
    lowest: dict[tuple[str, str], float] = defaultdict(lambda: math.inf)
    for job, one in done.items():
        lowest[job.kind, job.problem] = min(lowest[job.kind, job.problem], *one.values)
    sizes = {one.name: one.n for one in more_wild.PROBLEMS}
    found: dict[tuple[str, str], dict[float, list[float]]] = defaultdict(lambda: {tau: [] for tau in TAUS})
    for job, one in done.items():
        low = lowest[job.kind, job.problem]
        for tau in TAUS:
            count = one.solved(low + tau * (one.values[0] - low))
            found[job.kind, job.method][tau].append(count / (sizes[job.problem] + 1))
    return found
