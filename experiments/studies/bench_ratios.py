"""The package against what the machine can do: rates and times as ratios, measured in turn in one run.

| row | measured | compared with |
|---|---|---|
| noise | picks, perturbations, points and density ratios of proposal "aggregate" | `torch.randn` of the same count |
| Hessian | `Estimate.hessian` | the bare matrix product of its samples |
| gradient + HVP | one gradient and one product from perturbations that are drawn again | three passes of noise |
| sparse regressions | slopes of 4 096 outputs, of 40 parameters each, for five priors | the same in torch |
| threads | the noise with one thread | with two |

A ratio above 1 says that the package is faster, or that two threads are.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch

import torch_zerohess as zh
from torch_zerohess.estimation.likelihood_ratio import LikelihoodRatio
from torch_zerohess.sampling import extension, kernels, proposals
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.sparse_regression import slopes_by_ridges


@dataclass(frozen=True)
class Ratio:
    """Median seconds of a measured operation and of what it is compared with, and the goal for the ratio, if any."""

    operation: str
    n: int
    samples: int
    seconds: float
    compared: float
    goal: float | None = None
    compared_with: str = ""

    @property
    def ratio(self) -> float:
        """How many times faster it is than what it is compared with."""
        return self.compared / self.seconds


def ratios(repeats: int, wide: tuple[int, ...] = (512, 2048), large: int = 1_000_000) -> list[Ratio]:
    """Measure all rows with one thread, and the scaling with two.

    Args:
        repeats: timings of which the median is reported.
        wide: parameters of the Hessians.
        large: parameters of the gradient and the product that draw their perturbations again.
    """
    rows = [noise(dtype, repeats) for dtype in (torch.float32, torch.float64)]
    rows += [hessian(n, repeats) for n in wide]
    rows.append(redrawn(large, max(1, repeats // 5)))
    rows.append(_regressions(max(1, repeats // 5)))
    rows.append(_threads(repeats))
    return rows


def noise(
    dtype: torch.dtype,
    repeats: int,
    n: int = 1024,
    samples: int = 64,
    device: str = "cpu",
    proposal: int = proposals.SECOND_ORDER,
) -> Ratio:
    """Compare a batch of perturbations, placed and weighted, with `torch.randn` of as many numbers."""
    x, sigma = torch.zeros(1, n, dtype=dtype, device=device), torch.ones(n, dtype=torch.float64, device=device)
    plain = finished(lambda: torch.randn(samples, n, dtype=dtype, device=device), device)
    seconds, compared = in_turn(sampler(x, sigma, samples, proposal), plain, repeats)
    return Ratio(f"noise, {str(dtype).removeprefix('torch.')}", n, samples, seconds, compared, 2.0, "randn")


def hessian(n: int, repeats: int, device: str = "cpu") -> Ratio:
    """Compare the Hessian of an estimate with the bare matrix product of its samples."""
    samples = 64
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(n, generator=generator, dtype=torch.float64).to(device)
    estimate = zh.estimate(lambda z: z.sin().sum(1), x, zh.Smoothing(sigma=0.1, samples=samples, seed=0))
    u, a = (torch.randn(2 * samples, columns, dtype=torch.float64, device=device) for columns in (n, 1))
    product = finished(lambda: u.mT @ (a * u), device)
    seconds, compared = in_turn(finished(estimate.hessian, device), product, repeats)
    return Ratio("Hessian", n, samples, seconds, compared, 0.85, "matrix product")


def redrawn(n: int, repeats: int, device: str = "cpu") -> Ratio:
    """Compare a gradient and a product from perturbations that are drawn again with three passes of noise."""
    samples = 32
    x, sigma = torch.zeros(1, n, device=device), torch.ones(n, dtype=torch.float64, device=device)
    v, a = (torch.ones(1, 1, count, dtype=torch.float64, device=device) for count in (n, 2 * samples))
    rows = kernels.pick_rows(0, 0, samples, n, proposals.SECOND_ORDER, x.device)
    stein = LikelihoodRatio(kernels.Redrawn(rows, x, sigma, True, True), a[:, 0])

    def derivatives() -> object:
        return stein.gradient(a), stein.hvp(a, v)

    seconds, compared = in_turn(finished(derivatives, device), sampler(x, sigma, samples), repeats)
    return Ratio("gradient + HVP, drawn again", n, samples, seconds, 3 * compared, 0.6, "noise")


def _regressions(repeats: int) -> Ratio:
    n, samples, m, keep = 1024, 64, 4096, 40
    generator = torch.Generator().manual_seed(0)
    u, d = torch.randn(samples, n, generator=generator), torch.randn(samples, m, generator=generator)
    index = torch.rand(m, n, generator=generator).topk(keep).indices
    previous = SparseJacobian(index, torch.ones(m, keep), torch.zeros(m, keep), n, torch.Size([m]))
    choices = [(0.1 * k, 0.1 * k) for k in range(1, 6)]

    def fit(compiled: bool) -> Callable[[], object]:
        def run() -> object:
            extension.available = compiled
            return slopes_by_ridges(u, d, index, index >= 0, previous, choices)

        return run

    available = extension.available
    try:
        seconds, compared = in_turn(fit(available), fit(False), repeats)
    finally:
        extension.available = available
    return Ratio("sparse regressions", n, samples, seconds, compared, compared_with="torch")


def _threads(repeats: int) -> Ratio:
    n, samples = 4096, 256
    noise = sampler(torch.zeros(1, n), torch.ones(n, dtype=torch.float64), samples)
    threads = torch.get_num_threads()

    def of(number: int) -> Callable[[], object]:
        def run() -> object:
            torch.set_num_threads(number)
            return noise()

        return run

    try:
        seconds, compared = in_turn(of(2), of(1), repeats)
    finally:
        torch.set_num_threads(threads)
    return Ratio("noise, two threads against one", n, samples, seconds, compared, 1.6)


def sampler(
    x: torch.Tensor, sigma: torch.Tensor, samples: int, proposal: int = proposals.SECOND_ORDER
) -> Callable[[], object]:
    return finished(lambda: kernels.sample(0, samples, x, sigma, False, proposal, False, False), x.device.type)


def finished(function: Callable[[], object], device: str) -> Callable[[], object]:
    """Return the function with a wait for what it left running on the device."""

    def run() -> object:
        result = function()
        torch.cuda.synchronize()
        return result

    return run if device == "cuda" else function


def in_turn(first: Callable[[], object], second: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Return the median seconds of two functions that are called in turn, after one call of each."""
    first(), second()
    seconds: tuple[list[float], list[float]] = [], []
    for _ in range(repeats):
        for function, times in zip((first, second), seconds, strict=True):
            start = time.perf_counter()
            function()
            times.append(time.perf_counter() - start)
    return statistics.median(seconds[0]), statistics.median(seconds[1])
