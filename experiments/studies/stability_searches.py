"""The searches where optimization is hard: stiff, flat, indefinite, kinked, partly undefined, as noisy as it is high.

Every case is a function of two or ten parameters in units of sigma, with a start of value 1 and a minimum of value 0.
A run succeeds if the noiseless value at its result is at most `aim`. A run is wrong if `Minimum.success` is true and
it did not succeed. Under noise such claims are counted and not judged: 200 values whose noise is as large as the signal
do not determine the minimum. On a plateau without an end the message has to say that all values are equal.
"""

import statistics
import warnings
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.reports.progress import progress
from experiments.studies.stability_cases import tilted_axes

Function = Callable[[Tensor], Tensor]
ENDLESS = "plateau without an end"
ENGINES = ("gaussian_process", "descent")


@dataclass(frozen=True)
class HardCase:
    """A function [K, n] -> [K], and where a search for its minimum begins, with sigma = 1."""

    name: str
    fn: Function
    start: Tensor
    aim: float = 1e-3
    noise: float = 0.0
    """Standard deviation of the noise added to every value."""
    bounds: tuple[float, float] = (-10.0, 10.0)
    settings: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class SearchRow:
    """One row of the table."""

    case: str
    engine: str
    successes: float
    evaluations: float
    """Median over the runs."""
    claims: int
    """Runs that say that they have succeeded, and have not."""
    verdict: str
    message: str
    """The most frequent one."""


def hard_cases() -> list[HardCase]:
    """Return all cases."""
    two = torch.ones(2, dtype=torch.float64)
    stiff = [
        HardCase(f"stiff, condition 1e{decades}, n = {n}", _stiff(n, decades), torch.ones(n, dtype=torch.float64))
        for decades, n in ((0, 2), (6, 2), (12, 2), (12, 10))
    ]

    def saddle(z: Tensor) -> Tensor:
        return (z[:, 0] ** 2 - 1) ** 2 + z[:, 1] ** 2

    def half(z: Tensor) -> Tensor:
        value = (z - 1.5).square().sum(1) / 4.5
        return torch.where(z[:, 0] + z[:, 1] < -0.5, torch.nan, value)

    def beside(z: Tensor) -> Tensor:
        value = (z + 1.0).square().sum(1) / 8
        return torch.where((z.abs() < 0.4).all(1), torch.nan, value)

    def cut(z: Tensor, beyond: float) -> Tensor:
        value = (z.square().sum(1) - 0.5) / 5.625
        return torch.where(z.sum(1) < 1.0, beyond, value)

    def line(z: Tensor, weight: float) -> Tensor:
        value = (z - 1.5).square().sum(1) + weight * (z.sum(1) - 1.5).clamp(min=0)
        return (value - 1.125) / 7.375

    def hyperbola(z: Tensor, weight: float) -> Tensor:
        return (z.sum(1) + weight * (1 - z[:, 0] * z[:, 1]).clamp(min=0) - 2) / 2

    penalties = [
        HardCase(f"penalty of weight {weight:g} beyond a {name}", partial(fn, weight=weight), start)
        for weight in (1e2, 1e4)
        for name, fn, start in (("line", line, torch.tensor([0.0, -1.0]).double()), ("hyperbola", hyperbola, 2 * two))
    ]

    def bowl(z: Tensor) -> Tensor:
        return z.square().sum(1) / 18

    return [
        *stiff,
        HardCase("plateau that ends after 100 sigma", _plateau, 0 * two, bounds=(-150.0, 150.0)),
        HardCase(ENDLESS, lambda z: torch.ones(len(z)).double(), 0 * two),
        HardCase("start on a saddle", saddle, torch.zeros(2, dtype=torch.float64)),
        HardCase("NaN in a half-plane beside the start", half, 0 * two),
        HardCase("NaN between start and minimum", beside, two),
        HardCase("NaN beyond the minimum", partial(cut, beyond=torch.nan), 1.75 * two, bounds=(-4.0, 4.0)),
        HardCase("jump beyond the minimum", partial(cut, beyond=2.0), 1.75 * two, bounds=(-4.0, 4.0)),
        *penalties,
        HardCase("noise as large as the signal, not told", bowl, 3 * two, 0.1, 1.0),
        HardCase("noise as large as the signal, told", bowl, 3 * two, 0.1, 1.0, settings={"noise": 1.0}),
    ]


def searches(*, runs: int = 5, max_evaluations: int = 200, seed: int = 0) -> list[SearchRow]:
    """Run every engine on every case.

    Args:
        runs: seeds of each.
        max_evaluations: of a run.
        seed: of the first run.
    """
    cases = hard_cases()
    return [
        _row(case, engine, runs, max_evaluations, seed)
        for case, engine in progress([(case, engine) for case in cases for engine in ENGINES], "searches")
    ]


def _row(case: HardCase, engine: Any, runs: int, max_evaluations: int, seed: int) -> SearchRow:
    reached, evaluations, claims = 0, [], 0
    messages: Counter[str] = Counter()
    for run in range(runs):
        generator = torch.Generator().manual_seed(seed + run)

        def noisy(z: Tensor, generator: torch.Generator = generator) -> Tensor:
            return case.fn(z) + case.noise * torch.randn(len(z), generator=generator, dtype=torch.float64)

        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "all .* are equal so far")  # as they are on a plateau without an end
            found = zh.minimize(
                noisy,
                case.start,
                sigma=1.0,
                bounds=case.bounds,
                engine=engine,
                max_evaluations=max_evaluations,
                seed=seed + run,
                **case.settings,
            )
        good = float(case.fn(found.x[None])) <= case.aim
        reached, claims = reached + good, claims + (found.success and not good)
        evaluations.append(found.evaluations)
        messages[f"{found.status}: {found.message}"] += 1
    message = messages.most_common(1)[0][0]
    verdict = "WRONG: claims" if claims and not case.noise else "right"
    if case.name == ENDLESS and "values are equal" not in message:
        verdict = "WRONG: message"
    return SearchRow(case.name, engine, reached / runs, statistics.median(evaluations), claims, verdict, message)


def _stiff(n: int, decades: int) -> Function:
    """A quadratic with the eigenvalues and eigenvectors of `tilted_axes`; 1 at ones."""
    spectrum, turn = tilted_axes(n, decades)
    size = float(((turn @ torch.ones(n, dtype=torch.float64)).square() * spectrum).sum())
    return lambda z: ((z @ turn).square() * spectrum).sum(1) / size


def _plateau(z: Tensor) -> Tensor:
    """1 within 100 of zero along the first axis, falling to 0 in the 30 beyond."""
    return 1.0 - ((z[:, 0].abs() - 100.0) / 30.0).clamp(0.0, 1.0)
