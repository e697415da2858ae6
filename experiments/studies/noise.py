"""`python -m experiments noise`: our search and others on functions of BBOB with noise.

Every value has normal noise of a fixed size. What counts is the loss without noise at the point that a method returns:
`Minimum.x` of ours, the mean of the distribution of CMA-ES (`xfavorite`), and the solution of Py-BOBYQA, which is told
that values are noisy. All methods have the same starts, box, size of the first step and evaluations. Ours and Py-BOBYQA
start again by themselves. CMA-ES does not, and none of them is started again from outside.

Each function has one valley: a sphere; one that is a hundred times as steep on one side as on the other (attractive
sector); Rosenbrock's curved valley; an ellipsoid whose axes differ by a factor of a thousand; and different powers of
the parameters. Instances 11 to 15 are for tuning, 1 to 5 for tables.
"""

import itertools
import statistics
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.ensembles.kept_parts import KeptParts
from experiments.problems import bbob
from experiments.problems.catalogue import chosen
from experiments.reports.progress import progress
from experiments.reports.result_files import may_keep, show
from experiments.reports.tables import grouped

FUNCTIONS: Mapping[int, str] = {
    1: "sphere",
    6: "attractive sector",
    8: "Rosenbrock",
    10: "ellipsoid",
    14: "different powers",
}
HEADERS = ("function", "n", "noise", "method", "evaluations", "loss", "largest", "runs")

Noisy = Callable[[Tensor], Tensor]
"""Points [K, n] to values with noise [K]."""


@dataclass(frozen=True)
class Job:
    """One method on one function from one start."""

    method: str
    function: int
    instance: int
    run: int
    n: int
    budget: int
    """Evaluations over n."""
    noise: float
    """Standard deviation of a value."""


@dataclass(frozen=True)
class End:
    """What a method returned."""

    loss: float
    """Without noise, there."""
    evaluations: int


def noise(
    *,
    n: tuple[int, ...] = (5,),
    functions: tuple[int, ...] = tuple(FUNCTIONS),
    instances: tuple[int, ...] = (11, 12, 13, 14, 15),
    methods: str = "all",
    runs: int = 2,
    budget: int = 200,
    size: float = 1.0,
    out: Path = Path("results/noise"),
    store: str | None = None,
) -> None:
    """Print the median loss without noise where methods end; called again it goes on where it was.

    Args:
        n: numbers of parameters, among 2, 3, 5, 10, 20 and 40.
        functions: of BBOB, 1 to 24.
        instances: of every function, from 1 on; 11 to 15 are for tuning.
        methods: names separated by commas, or all: ours (told of the noise), ours_untold (measures it at the start),
            cma_es, py_bobyqa.
        runs: starts for every function.
        budget: evaluations over n that a run may use.
        size: standard deviation of the noise.
        out: folder; runs that the same code has made there are not made again.
        store: name under which the table is kept for the documents, as experiments/results/NAME.csv.
    """
    if runs < 1 or budget < 1 or not size > 0:
        raise SystemExit(f"runs and budget must be at least 1, size positive, got {runs}, {budget} and {size:g}")
    bbob.check(n, functions, instances)
    may_keep(store)
    torch.set_num_threads(1)
    names = METHODS if methods.strip() == "all" else chosen("methods", methods.split(","), tuple(METHODS))
    parts, done = KeptParts(out), dict[Job, End]()
    combinations = itertools.product(n, functions, names, instances, range(runs))
    jobs = [
        Job(name, function, instance, run, one, budget, size) for one, function, name, instance, run in combinations
    ]
    for job in progress(jobs, "runs"):
        (done[job],) = parts.rows(asdict(job), End, partial(_run, job))
    show(HEADERS, rows(done), store)


def rows(done: Mapping[Job, End]) -> list[list[object]]:
    """Return a row per function, number of parameters, noise and method."""
    groups = grouped(done.items(), lambda run: (run[0].function, run[0].n, run[0].noise, run[0].method))
    return [
        [
            *(FUNCTIONS.get(function, f"f{function}"), n, size, method),
            *(statistics.median(one.evaluations for _, one in group), statistics.median(one.loss for _, one in group)),
            *(max(one.loss for _, one in group), len(group)),
        ]
        for (function, n, size, method), group in groups.items()
    ]


def _run(job: Job) -> list[End]:
    task = bbob.task(job.function, job.instance, job.n, job.budget * job.n)
    generator, count = torch.Generator().manual_seed(job.run), 0

    def noisy(x: Tensor) -> Tensor:
        nonlocal count
        count += len(x)
        values = task.loss(x)
        return values + job.noise * torch.randn(values.shape, generator=generator, dtype=torch.float64)

    end = METHODS[job.method](noisy, task.start(job.run), job)
    return [End(float(task.loss(end[None])[0]), count)]


def _ours(noisy: Noisy, start: Tensor, job: Job, *, told: bool) -> Tensor:
    return zh.minimize(
        noisy,
        start,
        sigma=bbob.SIGMA,
        bounds=(-bbob.SIDE, bbob.SIDE),
        noise=job.noise if told else None,
        max_evaluations=job.budget * job.n,
        seed=job.run,
    ).x


def _cma_es(noisy: Noisy, start: Tensor, job: Job) -> Tensor:
    import cma

    most = job.budget * job.n
    options = {"bounds": [-bbob.SIDE, bbob.SIDE], "seed": job.run + 1, "verbose": -9, "maxfevals": most}
    strategy = cma.CMAEvolutionStrategy(start.numpy(), bbob.SIGMA, options)
    while not strategy.stop():
        points = strategy.ask()
        strategy.tell(points, noisy(torch.from_numpy(np.array(points))).tolist())
    return torch.from_numpy(strategy.result.xfavorite).clamp(-bbob.SIDE, bbob.SIDE)


def _py_bobyqa(noisy: Noisy, start: Tensor, job: Job) -> Tensor:
    import pybobyqa

    side = np.full(job.n, bbob.SIDE)
    found = pybobyqa.solve(
        lambda x: float(noisy(torch.from_numpy(x)[None])[0]),
        start.numpy(),
        bounds=(-side, side),
        rhobeg=bbob.SIGMA,
        maxfun=job.budget * job.n,
        objfun_has_noise=True,
        do_logging=False,
    )
    return torch.from_numpy(found.x)


METHODS: Mapping[str, Callable[[Noisy, Tensor, Job], Tensor]] = {
    "ours": partial(_ours, told=True),
    "ours_untold": partial(_ours, told=False),
    "cma_es": _cma_es,
    "py_bobyqa": _py_bobyqa,
}
