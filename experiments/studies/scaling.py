"""Where further workers stop paying: measured for the workers of this machine, simulated for up to 10 000.

The simulation follows `evaluators`: one process gives chunks of a batch to idle workers, and takes their values, one
after the other.

| stated | workers of this machine (`ProcessPool`) | actors of a cluster (`Ray`) |
|---|---|---|
| chunks of a batch | at most 256 | one per actor |
| the caller's time per chunk, to send and to receive | 0.1 ms, 0.1 ms | 0.3 ms, 0.3 ms |
| latency, each way | 0.05 ms | 1 ms, or 50 ms |

Times of renders are log-normal: their median is stated, the standard deviation of their logarithm is 0.25.
Speed-up = sum of all render times / time of the batch. Efficiency is speed-up over workers. Workers pay as long as it
is at least one half.
"""

import csv
import heapq
import math
import random
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from experiments.reports.tables import table
from torch_zerohess.evaluators import Factory, ProcessPool
from torch_zerohess.evaluators.batch import MOST, cut

WORKERS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000, 10_000)
POINTS = (16, 256, 4096, 65_536)
SECONDS = (0.001, 0.01, 0.1, 1.0, 10.0)
"""Of a render, the median."""
PAYING = 0.5
"""Efficiency."""
_SPREAD = 0.25


@dataclass(frozen=True)
class Carrier:
    """How chunks get to workers; seconds."""

    name: str
    send: float
    receive: float
    latency: float
    most: int | None
    """Chunks of a batch; one per worker if None."""

    def chunks(self, points: int, workers: int) -> list[int]:
        """Return the points of every chunk."""
        return [len(one) for one in cut(points, self.most or workers)]


CARRIERS = (
    Carrier("processes", 1e-4, 1e-4, 5e-5, MOST),
    Carrier("cluster, 1 ms", 3e-4, 3e-4, 1e-3, None),
    Carrier("cluster, 50 ms", 3e-4, 3e-4, 5e-2, None),
)


@dataclass(frozen=True)
class Row:
    """A batch in so many workers."""

    kind: str
    """simulated, or measured."""
    carrier: str
    workers: int
    points: int
    render: float
    """Median seconds of a point."""
    seconds: float
    """Of the batch."""
    speedup: float

    @property
    def efficiency(self) -> float:
        return self.speedup / self.workers


def simulated(carrier: Carrier, workers: int, times: Sequence[float]) -> float:
    """Return the seconds of a batch whose points take `times`."""
    waiting, first = [], 0
    for size in carrier.chunks(len(times), workers):
        waiting.append(math.fsum(times[first : first + size]))
        first += size
    waiting.reverse()
    now, idle = 0.0, workers
    arrivals: list[float] = []
    while waiting or arrivals:
        if waiting and idle:
            now, idle = now + carrier.send, idle - 1
            heapq.heappush(arrivals, now + waiting.pop() + 2 * carrier.latency)
        else:
            now, idle = max(now, heapq.heappop(arrivals)) + carrier.receive, idle + 1
    return now


def simulation(seed: int = 0) -> list[Row]:
    """Return all simulated rows."""
    rows = []
    chance = random.Random(seed)
    spreads = [chance.lognormvariate(0.0, _SPREAD) for _ in range(max(POINTS))]
    for carrier in CARRIERS:
        for points in POINTS:
            for render in SECONDS:
                times = [render * one for one in spreads[:points]]
                whole = math.fsum(times)
                for workers in WORKERS:
                    seconds = simulated(carrier, workers, times)
                    rows.append(Row("simulated", carrier.name, workers, points, render, seconds, whole / seconds))
    return rows


class Waiting:
    """A black box that takes a stated time and no core, as a render elsewhere."""

    def __init__(self, seconds: float) -> None:
        self.seconds = seconds

    def __call__(self, x: Tensor) -> Tensor:
        """Return values [K] of x [K, n]."""
        time.sleep(len(x) * self.seconds)
        return x[:, 0].clone()


def measurement(workers: Sequence[int], points: int = 64, render: float = 0.01, repeats: int = 5) -> list[Row]:
    """Return measured rows: a batch of points that take `render` seconds each."""
    rows, x = [], torch.zeros(points, 2)
    for count in workers:
        with ProcessPool(count) as pool:
            fn, seconds = Factory(Waiting, render), []
            pool(fn, x)
            for _ in range(repeats):
                began = time.perf_counter()
                pool(fn, x)
                seconds.append(time.perf_counter() - began)
        median = statistics.median(seconds)
        rows.append(Row("measured", CARRIERS[0].name, count, points, render, median, points * render / median))
    return rows


def paying(rows: Sequence[Row]) -> dict[tuple[str, int, float], int]:
    """Return by carrier, points and seconds of a render the most workers that pay; 0 if one does not."""
    most: dict[tuple[str, int, float], int] = {}
    for row in rows:
        key = row.carrier, row.points, row.render
        most[key] = max(most.get(key, 0), row.workers if row.efficiency >= PAYING else 0)
    return most


def scaling(workers: int, out: Path) -> list[Row]:
    """Measure up to so many workers, simulate up to 10 000, print what pays, and write all rows as CSV."""
    own = measurement(range(1, workers + 1))
    rows = own + simulation()
    out.parent.mkdir(parents=True, exist_ok=True)
    with out.open("w", newline="") as file:
        writer = csv.DictWriter(file, [*asdict(rows[0]), "efficiency"], lineterminator="\n")
        writer.writeheader()
        for row in rows:
            numbers = {"seconds": row.seconds, "speedup": row.speedup, "efficiency": row.efficiency}
            writer.writerow(asdict(row) | {name: f"{one:.6g}" for name, one in numbers.items()})
    compared = []
    for row in own:
        expected = simulated(CARRIERS[0], row.workers, [row.render] * row.points)
        compared.append([row.workers, row.points, 1e3 * row.render, row.seconds, expected])
    print(table(["workers", "points", "render [ms]", "measured [s]", "simulated [s]"], compared))
    most = paying([row for row in rows if row.kind == "simulated"])
    lines = [[c.name, K, *(most[c.name, K, one] for one in SECONDS)] for c in CARRIERS for K in POINTS]
    print(f"\nMost workers that pay (efficiency of at least {PAYING:g}), by seconds of a render:\n")
    print(table(["workers are", "points", *(f"{one:g} s" for one in SECONDS)], lines))
    return rows
