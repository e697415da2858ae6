"""Cost of the package itself, without the black box: the extension against the pure-torch path, and memory.

Both paths are timed in one run and in turn, so that whatever else the machine does falls on both alike.
"""

import gc
import json
import multiprocessing
import statistics
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.reports.progress import progress
from experiments.reports.result_files import keep, may_keep
from experiments.reports.tables import table
from experiments.runs.outputs import check_file
from experiments.runs.records import write
from experiments.studies.bench_memory import memory_ratios
from experiments.studies.bench_ratios import Ratio, ratios
from torch_zerohess.estimation import perturbations
from torch_zerohess.sampling import extension, kernels, proposals

_SHORTEST = 2e-3  # seconds; a shorter call is repeated within one timing


@dataclass(frozen=True)
class Timing:
    """Median seconds of one operation on both paths; `extension` is None where it was not built."""

    operation: str
    n: int
    samples: int
    extension: float | None
    torch: float

    @property
    def ratio(self) -> float | None:
        """How many times faster the extension is."""
        return self.torch / self.extension if self.extension else None


@dataclass(frozen=True)
class Footprint:
    """MiB above what the process holds before: what a graph keeps, and the peak of forward, backward and an HVP."""

    perturbations: str
    n: int
    samples: int
    kept: float
    peak: float


@dataclass(frozen=True)
class BenchReport:
    """Everything `bench` measured."""

    timings: list[Timing]
    memory: list[Footprint]
    ratios: list[Ratio]


def bench(
    *,
    repeats: int = 51,
    sizes: tuple[tuple[int, int], ...] = ((2, 8), (1024, 64)),
    memory_n: int = 100_000,
    memory_samples: int = 64,
    wide: tuple[int, ...] = (512, 2048),
    large: int = 1_000_000,
    remembered: int = 4000,
    out: Path | None = None,
    store: str | None = None,
) -> BenchReport:
    """Time estimates, their parts and the autograd layer without a black box, with and without the extension.

    Args:
        repeats: timings of which the median is reported.
        sizes: pairs of parameters n and antithetic samples.
        memory_n: parameters of the memory measurement; 0 leaves it out.
        memory_samples: its antithetic samples.
        wide: parameters of the Hessians that are compared with matrix products; empty leaves all ratios out.
        large: parameters of the gradient and the product that draw their perturbations again.
        remembered: evaluations in the memory of a layer, timed against renders of MUG; 0 leaves it out.
        out: JSON file to write.
        store: name of the table of times that is kept under experiments/results, for the documents; the comparison
            with the machine is kept as NAME_ratios.
    """
    smallest = min((number for pair in sizes for number in pair), default=0)
    given = {"repeats": repeats, "sizes": smallest, "memory_samples": memory_samples, "memory_n": memory_n}
    given |= {"wide": min(wide, default=1), "large": large, "remembered": remembered}
    for name, value in given.items():
        least = 0 if name in ("memory_n", "remembered") else 1
        if value < least:
            raise SystemExit(f"{name} must be at least {least}, got {value}")
    check_file(out)
    may_keep(store)
    threads, available = torch.get_num_threads(), extension.available
    torch.set_num_threads(1)
    timed = [(*size, name, operation) for size in sizes for name, operation in _operations(*size).items()]
    try:
        timings = [
            _timing(name, operation, n, samples, repeats, available)
            for n, samples, name, operation in progress(timed, "timings")
        ]
        compared = ratios(repeats, wide, large) if wide and available else []
        compared += memory_ratios(remembered, max(3, repeats // 5)) if remembered else []
    finally:
        torch.set_num_threads(threads)
        extension.available = available
    memory = []
    if memory_n:
        memory = [_memory(name, memory_n, memory_samples) for name in progress(("stored", "redrawn"), "memory")]
    report = BenchReport(timings, memory, compared)
    _print(report)
    if out is not None:
        rows = [{**asdict(t), "ratio": t.ratio} for t in timings]
        against = [{**asdict(r), "ratio": r.ratio} for r in compared]
        memories = [asdict(m) for m in memory]
        write(out, json.dumps({"timings": rows, "memory": memories, "ratios": against}, indent=1))
    if store is not None:
        print(keep(*_table(report), store))
        if compared:
            print(keep(*_compared(report), f"{store}_ratios"))
    return report


def _operations(n: int, samples: int) -> dict[str, Callable[[], object]]:
    """What is timed, by name: whole estimates, the autograd layer, then the kernels they are made of."""
    smoothing = zh.Smoothing(sigma=0.1, samples=samples, seed=0)
    values = torch.rand(smoothing.evaluations(n), dtype=torch.float64)
    generator = torch.Generator().manual_seed(0)
    x, v = torch.randn(2, n, generator=generator, dtype=torch.float64)
    leaf = x.clone().requires_grad_()
    layer = zh.smooth(lambda points: values[: len(points)], smoothing)
    K = 2 * samples
    sigma = smoothing.sigma_vector(n, x.device)
    rows = kernels.pick_rows(0, 0, samples, n, proposals.SECOND_ORDER, x.device)
    drawn = kernels.draw(rows, n)
    u = kernels.place(drawn, x[None], sigma, True, False, proposals.SECOND_ORDER)[1]
    t, a = v.reshape(1, 1, n), values[:K].reshape(1, 1, K)

    def estimates() -> object:
        result = zh.estimate(lambda points: values[: len(points)], x, smoothing)
        return result.value, result.gradient, result.hvp(v)

    def backward() -> object:
        return torch.autograd.grad(layer(leaf), leaf)

    def double_backward() -> object:
        (gradient,) = torch.autograd.grad(layer(leaf), leaf, create_graph=True)
        return torch.autograd.grad(gradient @ v, leaf)

    return {
        "value + gradient + HVP": estimates,
        "layer: forward + backward": backward,
        "layer: double backward (HVP)": double_backward,
        "draw": lambda: kernels.draw(kernels.pick_rows(0, 0, samples, n, proposals.SECOND_ORDER, x.device), n),
        "place": lambda: kernels.place(drawn, x[None], sigma, True, False, proposals.SECOND_ORDER),
        "project": lambda: kernels.project(u, t),
        "accumulate": lambda: kernels.accumulate(u, a),
        "hessian": lambda: kernels.hessian(u, a),
    }


def _timing(name: str, operation: Callable[[], object], n: int, samples: int, repeats: int, available: bool) -> Timing:
    paths = [True, False] if available else [False]
    seconds: dict[bool, list[float]] = {path: [] for path in paths}
    number = {}
    for path in paths:
        extension.available = path
        operation()
        number[path] = max(1, int(_SHORTEST / max(_seconds(operation, 3), 1e-9)))
    gc.collect()
    for _ in range(repeats):
        for path in paths:
            extension.available = path
            seconds[path].append(_seconds(operation, number[path]))
    extension.available = available
    median = {path: statistics.median(each) for path, each in seconds.items()}
    return Timing(name, n, samples, median.get(True), median[False])


def _seconds(operation: Callable[[], object], number: int) -> float:
    start = time.perf_counter()
    for _ in range(number):
        operation()
    return (time.perf_counter() - start) / number


def _memory(name: str, n: int, samples: int) -> Footprint:
    """Measure in a new process, whose peak is its own."""
    context = multiprocessing.get_context("spawn")
    receiver, sender = context.Pipe(duplex=False)
    process = context.Process(target=_measure_memory, args=(sender, name == "stored", n, samples))
    process.start()
    sender.close()
    kept, peak = receiver.recv()
    process.join()
    return Footprint(name, n, samples, kept, peak)


def _measure_memory(sender: Connection, stored: bool, n: int, samples: int) -> None:
    torch.set_num_threads(1)
    perturbations.STORED = 1 << 62 if stored else 0

    def fn(points: Tensor) -> Tensor:
        return points[:, 0].clone()

    def run(size: int) -> tuple[float, float]:
        layer = zh.smooth(fn, zh.Smoothing(sigma=0.1, samples=samples, seed=0))
        x = torch.zeros(size, requires_grad=True)
        before = _status("VmRSS")
        y = layer(x)
        kept = _status("VmRSS") - before
        (gradient,) = torch.autograd.grad(y, x, create_graph=True)
        torch.autograd.grad(gradient.sum(), x)
        return kept, _status("VmHWM") - before

    run(2)
    sender.send(run(n))
    sender.close()


def _status(field: str) -> float:
    """MiB of a line of Linux's /proc/self/status; NaN on other systems."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return float("nan")
    return next(float(line.split()[1]) / 1024 for line in lines if line.startswith(f"{field}:"))


def _table(report: BenchReport) -> tuple[list[str], list[list[object]]]:
    """Return headers and rows of the times."""

    def micro(seconds: float | None) -> float | None:
        return None if seconds is None else round(1e6 * seconds, 1)

    headers = ["operation", "parameters", "pairs of samples", "extension [us]", "pure torch [us]", "ratio"]
    return headers, [[t.operation, t.n, t.samples, micro(t.extension), micro(t.torch), t.ratio] for t in report.timings]


def _compared(report: BenchReport) -> tuple[list[str], list[list[object]]]:
    """Return headers and rows of what the package does against what the machine can do."""
    headers = ["operation", "parameters", "samples", "package [us]", "compared [us]", "ratio", "goal"]
    rows: list[list[object]] = [
        [r.operation, r.n, r.samples, round(1e6 * r.seconds, 1), round(1e6 * r.compared, 1), r.ratio, r.goal]
        for r in report.ratios
    ]
    return headers, rows


def _print(report: BenchReport) -> None:
    print("Median microseconds without the black box, one thread\n")
    print(table(*_table(report)))
    if report.ratios:
        print("\nAgainst what the machine can do: microseconds, and how many times faster the package is\n")
        print(table(*_compared(report)))
    if report.memory:
        print("\nMiB of a layer: kept by its graph, and peak of forward, backward and one HVP (float32 points)\n")
        memory = [[m.perturbations, m.n, m.samples, round(m.kept), round(m.peak)] for m in report.memory]
        print(table(["perturbations", "n", "samples", "kept", "peak"], memory))
