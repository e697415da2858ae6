"""What `zh.minimize` says at the end of a noisy search, against the truth: value, gradient and Hessian with errors.

The functions are sums over the parameters, or images, whose derivatives at the point that was returned are known by
`torch.func`. A row has the shares of entries that lie within twice their standard error. No run is left out.
"""

import math
import statistics
from collections.abc import Callable
from dataclasses import astuple, dataclass
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.reports import result_files
from experiments.reports.progress import progress

HEADERS = ("function", "parameters", "evaluations", "value", "gradient", "Hessian", "error of the Hessian", "runs")
_START = 1.5
"""Every parameter of the start, in units of sigma."""
_PIXELS = 40


@dataclass(frozen=True)
class Problem:
    """A loss of points [*, n] -> [*], and noise of its values, or of the pixels of the image before the loss."""

    loss: Callable[[Tensor], Tensor]
    noise: float
    image: Callable[[Tensor], Tensor] | None = None
    """[K, n] -> [K, m]; the loss is the mean of its squares, without what the noise adds."""


@dataclass(frozen=True)
class Row:
    """Shares of entries within twice their standard error, over all runs."""

    function: str
    n: int
    evaluations: int
    value: float
    gradient: float
    hessian: float
    """Of its diagonal."""
    error: float
    """Median over the runs of the root mean square error of the diagonal, over its mean absolute value."""
    runs: int


def problems(n: int) -> dict[str, Problem]:
    """Return the functions of n parameters, by name."""
    weights = torch.arange(1.0, n + 1, dtype=torch.float64)
    directions = torch.randn(_PIXELS, n, generator=torch.Generator().manual_seed(3), dtype=torch.float64)

    def bowl(z: Tensor) -> Tensor:
        return (z.square() * weights).sum(-1)

    def image(z: Tensor) -> Tensor:
        return torch.tanh(0.4 * z @ directions.mT)

    return {
        "quadratic": Problem(bowl, 0.5),
        "quartic": Problem(lambda z: bowl(z) + (0.5 * z**4 + 0.3 * z**3).sum(-1), 0.5),
        "cosh": Problem(lambda z: (torch.cosh(z - 0.3) + torch.exp(0.5 * z)).sum(-1), 0.5),
        "valley": Problem(lambda z: ((1 - z[..., :-1]) ** 2 + 5 * (z[..., 1:] - z[..., :-1] ** 2) ** 2).sum(-1), 0.5),
        "tip": Problem(lambda z: 2 * torch.log1p(bowl(z)), 0.5),
        "image": Problem(lambda z: image(z).square().mean(-1), 0.3, image),
    }


def minima(
    n: tuple[int, ...] = (2, 3, 6),
    evaluations: tuple[int, ...] = (150, 400),
    runs: int = 30,
    seed: int = 0,
    store: str | None = None,
) -> list[Row]:
    """Print how often value, gradient and Hessian diagonal at the end of noisy searches are within two errors.

    Args:
        n: parameters, 2 or more.
        evaluations: of a search.
        runs: searches of every function, with noise of their own.
        seed: of the first run.
        store: name under which the table is kept.
    """
    if not n or min(n) < 2 or not evaluations or runs < 1:
        raise SystemExit(f"n must be 2 or more and runs at least 1, got {n}, {evaluations} and {runs}")
    result_files.may_keep(store)
    torch.set_num_threads(1)
    cases = [(name, size, count) for size in n for count in evaluations for name in problems(size)]
    rows = [judged(name, size, count, runs, seed) for name, size, count in progress(cases, "cases")]
    result_files.show(HEADERS, [list(astuple(row)) for row in rows], store)
    return rows


def judged(name: str, n: int, evaluations: int, runs: int, seed: int) -> Row:
    """Search for the minimum of one function several times, and compare what is said of it."""
    problem = problems(n)[name]
    values: list[bool] = []
    slopes: list[Tensor] = []
    bends: list[Tensor] = []
    errors: list[float] = []
    for run in range(seed, seed + runs):
        found = _searched(problem, n, evaluations, run)
        offset = 0.0 if problem.image is None else problem.noise**2
        values.append(abs(found.value - offset - float(problem.loss(found.x))) <= 2 * found.value_error)
        slope = torch.func.grad(problem.loss)(found.x)
        bend = torch.func.hessian(problem.loss)(found.x).diagonal()
        if found.gradient is None or found.hessian is None or found.standard_errors is None:  # nothing is claimed
            slopes.append(0 * slope)
            bends.append(0 * slope)
            errors.append(math.inf)
            continue
        said = found.standard_errors
        off = found.hessian.diagonal() - bend
        slopes.append(((found.gradient - slope).abs() <= 2 * said["gradient"]).double())
        bends.append((off.abs() <= 2 * said["hessian_diagonal"]).double())
        errors.append(float(off.square().mean().sqrt() / bend.abs().mean()))
    gradient, hessian = (float(torch.stack(one).mean()) for one in (slopes, bends))
    return Row(name, n, evaluations, sum(values) / runs, gradient, hessian, statistics.median(errors), runs)


def _searched(problem: Problem, n: int, evaluations: int, run: int) -> zh.Minimum:
    generator = torch.Generator().manual_seed(run)

    def noisy(z: Tensor) -> Tensor:
        output = problem.loss(z) if problem.image is None else problem.image(z)
        return output + problem.noise * torch.randn(output.shape, generator=generator, dtype=torch.float64)

    loss: dict[str, Any] = {} if problem.image is None else {"loss": lambda output: output.square().mean()}
    start = torch.full((n,), _START, dtype=torch.float64)
    return zh.minimize(noisy, start, sigma=1.0, max_evaluations=evaluations, seed=run, **loss)
