"""`python -m experiments optimizers`: our search and other optimizers on BBOB, or on smooth losses of users' kinds.

A pair is a function instance and a precision, of the targets of its family. A method reaches a pair once it has
evaluated a point whose value is within the precision of the minimum. The table has the share of pairs reached after
10 n, 30 n and 100 n evaluations, and after 500 n if runs may use so many. Every method gets the same starts, the same
box and the same size of the first step. A method that ends by itself starts again from a random point of the box.

Instances 11 to 15 are for tuning, 1 to 5 for tables. `--over` compares settings of a method; rivals have those of
`experiments.methods.settings.rivals`.
"""

import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import torch
from torch import Tensor

from experiments.ensembles.kept_parts import KeptParts
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.methods.ours import search
from experiments.methods.settings.rivals import ON_BBOB
from experiments.problems import bbob, smooth_losses
from experiments.problems.task import Task
from experiments.reports import data_profiles
from experiments.reports.progress import progress
from experiments.reports.result_files import may_keep
from experiments.reports.tables import grouped
from experiments.studies.benchmark_suite import Settings, Suite, row_name, solve
from torch_zerohess.optim import TrustRegion

OURS = Method("ours", "TrustRegion with its defaults", with_settings(search, output=False))
RIVALS = ("cobyqa", "py_bobyqa", "lbfgs_fd", "cma_es_bounded")
BUDGETS = (10, 30, 100)
"""Evaluations over n after which the table counts,"""
LARGE = 500
"""and also after this many where runs may use them."""


def budgets(most: int) -> tuple[int, ...]:
    """Return the evaluations over n after which the table of runs of so many evaluations counts."""
    return (*BUDGETS, LARGE) if most >= LARGE else BUDGETS


def suite(most: int) -> Suite:
    """Return what is compared, with the headers of the table for runs of so many evaluations over n."""
    headers = ("n", "method", *(f"{budget} n" for budget in budgets(most)), "ms per evaluation", "runs")
    return Suite(OURS, RIVALS, ON_BBOB, headers, "targets reached", "n")


SUITE = suite(BUDGETS[-1])


@dataclass(frozen=True)
class Family:
    """Functions by their numbers."""

    numbers: tuple[int, ...]
    targets: tuple[float, ...]
    """Precisions, the coarsest first."""
    check: Callable[[Sequence[int], Sequence[int], Sequence[int]], None]
    """SystemExit for n, functions or instances that the family does not have."""
    task: Callable[[int, int, int, int], Task]
    """Function, instance, n and evaluations to the task."""


FAMILIES = {
    "bbob": Family(bbob.FUNCTIONS, bbob.TARGETS, bbob.check, bbob.task),
    "smooth": Family(smooth_losses.FUNCTIONS, smooth_losses.TARGETS, smooth_losses.check, smooth_losses.task),
}


@dataclass(frozen=True)
class Job:
    """One method on one function from one start."""

    family: str
    n: int
    function: int
    instance: int
    run: int
    method: str
    budget: int
    """Evaluations over n."""
    settings: Settings = ()

    @property
    def targets(self) -> tuple[float, ...]:
        """Precisions, the coarsest first."""
        return FAMILIES[self.family].targets


@dataclass(frozen=True)
class Reached:
    """Evaluations until each target that was reached, the coarsest first, and seconds of the processor."""

    evaluations: Sequence[int]
    seconds: float


def optimizers(
    *,
    family: Literal["bbob", "smooth"] = "bbob",
    n: tuple[int, ...] = (2, 3, 5, 10),
    functions: tuple[int, ...] | None = None,
    instances: tuple[int, ...] = (11, 12),
    methods: str = "all",
    runs: int = 1,
    budget: int = BUDGETS[-1],
    limit: float = 600.0,
    over: tuple[str, ...] = (),
    out: Path = Path("results/optimizers"),
    store: str | None = None,
) -> None:
    """Print and draw shares of (function, precision) pairs reached; called again it goes on where it was.

    Args:
        family: the functions of BBOB, or smooth losses of users' kinds.
        n: numbers of parameters; of BBOB among 2, 3, 5, 10, 20 and 40.
        functions: their numbers in the family, by default all.
        instances: of every function, from 1 on; 11 to 15 are for tuning.
        methods: names separated by commas, or all: ours, cobyqa, py_bobyqa, lbfgs_fd, cma_es_bounded; or any that
            needs the loss alone, see `list`.
        runs: starts for every function.
        budget: evaluations over n that a run may use.
        limit: seconds that a run may take.
        over: settings of the one method in `methods` to compare, each with a row: `scale=0.25,0.5,1`.
        out: folder; runs that the same code has made there are not made again.
        store: name under which the table is kept for the documents, as experiments/results/NAME.csv.
    """
    if runs < 1 or budget < 1 or not limit > 0:
        raise SystemExit(f"runs and budget must be at least 1, limit positive, got {runs}, {budget} and {limit:g}")
    members = FAMILIES[family]
    functions = members.numbers if functions is None else functions
    members.check(n, functions, instances)
    may_keep(store)
    torch.set_num_threads(1)
    wanted = SUITE.wanted(methods, over)
    jobs = [
        Job(family, count, function, instance, run, name, budget, settings)
        for count, function, instance, run, (name, settings) in itertools.product(
            n, functions, instances, range(runs), wanted
        )
    ]
    parts, done = KeptParts(out), dict[Job, Reached]()
    for job in progress(jobs, "runs"):
        (done[job],) = parts.rows(asdict(job) | {"limit": limit}, Reached, partial(_run, job, limit))
    suite(budget).conclude(rows(done), profiles(done), budget, out, store)


def _run(job: Job, limit: float) -> list[Reached]:
    task = FAMILIES[job.family].task(job.function, job.instance, job.n, job.budget * job.n)
    return [reached(task, job.targets, SUITE.method(job.method), job.run, limit, dict(job.settings))]


def reached(
    task: Task,
    targets: Sequence[float],
    method: Method,
    run: int,
    limit: float = 600.0,
    settings: Mapping[str, Any] | None = None,
) -> Reached:
    """Run a method until the evaluations of the task are used up or the finest target is reached."""
    hits: list[int] = []
    count = 0

    def loss(x: Tensor) -> Tensor:
        nonlocal count
        values = task.loss(x)
        for value in values.tolist():
            count += 1
            while len(hits) < len(targets) and value <= targets[len(hits)]:
                hits.append(count)
        return values

    outcome = solve(replace(task, loss=loss), method, run, limit, settings)
    return Reached(tuple(hits), outcome.seconds)


def rows(done: Mapping[Job, Reached]) -> list[list[object]]:
    """Return a row per number of parameters and method; None for more evaluations than the runs could use."""
    return list(_rows(grouped(done.items(), _row)))


def profiles(done: Mapping[Job, Reached]) -> dict[str, dict[str, data_profiles.Profile]]:
    """Return, by "n = ..." and method, evaluations over n of all pairs reached, and the count of pairs."""
    found: dict[str, dict[str, data_profiles.Profile]] = defaultdict(dict)
    for (n, name), group in grouped(done.items(), _row).items():
        counts = [count / n for _, one in group for count in one.evaluations]
        found[f"n = {n}"][name] = counts, sum(len(job.targets) for job, _ in group)
    return found


def _row(run: tuple[Job, Reached]) -> tuple[int, str]:
    """Return n and the name of the row of a run: the method with its settings; ours with the engine that it chooses."""
    job, _ = run
    if job.method == OURS.name:
        return job.n, f"{job.method}: {TrustRegion(torch.zeros(job.n), sigma=1.0, bounds=(-5.0, 5.0)).engine}"
    return job.n, row_name(job.method, job.settings)


def _rows(groups: Mapping[tuple[int, str], Sequence[tuple[Job, Reached]]]) -> Iterator[list[object]]:
    for (n, name), group in groups.items():
        most = group[0][0].budget
        shares = [
            sum(_share(job, one, budget * n) for job, one in group) / len(group) if budget <= most else None
            for budget in budgets(most)
        ]
        # A run that has reached the finest target has ended there.
        used = sum(
            one.evaluations[-1] if len(one.evaluations) == len(job.targets) else job.budget * n for job, one in group
        )
        yield [n, name, *shares, 1e3 * sum(one.seconds for _, one in group) / used, len(group)]


def _share(job: Job, found: Reached, most: int) -> float:
    """Share of the targets that were reached within so many evaluations."""
    return sum(one <= most for one in found.evaluations) / len(job.targets)
