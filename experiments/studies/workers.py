"""Evaluation in worker processes: what a call costs, what two workers gain, and what kills and hangs change.

| row | measured | compared with |
|---|---|---|
| empty, 1 point | a call of the pool for a black box that does nothing | the same call in this process |
| empty, 16 points | the same | the same |
| 48 kB, 1 point | a value of 48 kB | the same |
| task | the images of a task, as many points as there are chunks for the workers | one process |

The faults are kills of workers at random times, and evaluations that hang. All values must equal the values of an
undisturbed call, bit by bit. No process may remain, and no file may be open that was not open before.
"""

import json
import multiprocessing
import os
import random
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from multiprocessing import resource_tracker
from pathlib import Path

import torch
from torch import Tensor

from experiments.problems import catalogue
from experiments.reports.progress import progress
from experiments.reports.tables import table
from experiments.runs.outputs import check_file
from experiments.runs.records import write
from experiments.studies.bench_ratios import in_turn
from torch_zerohess.evaluators import Factory, Inline, ProcessPool

_CALL = 200
"""Points of a call that is disturbed."""
_EARLY = 5
"""Kills before they are due."""
_IN_A_ROW = 4
"""Kills between two calls that end. A pool gives up a black box whose workers die more often without a value."""


@dataclass(frozen=True)
class Cost:
    """Median seconds of a call in workers and in this process."""

    call: str
    workers: int
    points: int
    pool: float
    inline: float

    @property
    def added(self) -> float:
        """Milliseconds that the pool adds."""
        return 1e3 * (self.pool - self.inline)

    @property
    def ratio(self) -> float:
        """How many times faster the workers are."""
        return self.inline / self.pool


@dataclass(frozen=True)
class Faults:
    """What was done to the workers, and what came of it."""

    evaluations: int
    kills: int
    hangs: int
    different: int
    """Values that differ in any bit from the values of an undisturbed call."""
    lost: int
    """Points without a value."""
    processes: int
    """Workers that are left after the pool was closed."""
    files: int
    """Open files that were not open before."""
    seconds: float

    @property
    def right(self) -> bool:
        return not (self.different or self.lost or self.processes or self.files)


def workers(
    *,
    count: int = 2,
    task: str | None = "mug",
    points: int = 64,
    repeats: int = 101,
    evaluations: int = 20_000,
    kills: int = 200,
    hangs: int = 50,
    seed: int = 0,
    out: Path | None = None,
) -> tuple[list[Cost], Faults | None]:
    """Measure the cost of worker processes, and disturb them.

    Args:
        count: workers.
        task: a fitting task whose images are made in the workers; none if empty.
        points: of a call for images.
        repeats: timings of which the median is reported; 0 leaves them out.
        evaluations: that are disturbed; 0 leaves them out.
        kills: of workers, at random times.
        hangs: evaluations that hang.
        seed: of the times.
        out: JSON file to write.

    Raises:
        SystemExit: with status 1, if a fault changed a value or left something.
    """
    least = {"count": (count, 1), "points": (points, 1), "repeats": (repeats, 0), "evaluations": (evaluations, 0)}
    for name, (value, smallest) in (least | {"kills": (kills, 0), "hangs": (hangs, 0)}).items():
        if value < smallest:
            raise SystemExit(f"{name} must be at least {smallest}, got {value}")
    if task:
        (task,) = catalogue.chosen("task", [task], list(catalogue.FITTING))
    check_file(out)
    costs = _costs(count, task, points, repeats) if repeats else []
    faults = disturb(count, evaluations, kills, hangs, seed) if evaluations else None
    if costs:
        rows = [[one.call, one.workers, one.points, 1e3 * one.pool, one.added, one.ratio] for one in costs]
        print(table(["call", "workers", "points", "pool [ms]", "added [ms]", "times faster"], rows))
    if faults:
        print(table(list(asdict(faults)), [list(asdict(faults).values())]))
    if out is not None:
        written = {"costs": [asdict(one) for one in costs], "faults": None if faults is None else asdict(faults)}
        write(out, json.dumps(written, indent=1))
    if faults and not faults.right:
        raise SystemExit(1)
    return costs, faults


def empty(x: Tensor) -> Tensor:
    """Do nothing: [K, n] -> [K]."""
    return x[:, 0].clone()


def image(x: Tensor) -> Tensor:
    """Return 48 kB per point: [K, n] -> [K, 64, 64, 3]."""
    return torch.zeros(len(x), 64, 64, 3)


def images_of(name: str) -> Callable[[Tensor], Tensor]:
    """Load a task, and return the function that makes its images, or its losses."""
    task = catalogue.fitting(name)
    made: Callable[[Tensor], Tensor] = task.loss if task.output is None else task.output.image
    return made


def _costs(count: int, task: str | None, points: int, repeats: int) -> list[Cost]:
    rows = []
    with ProcessPool(count) as pool:
        for name, fn, K in (("empty", empty, 1), ("empty", empty, 16), ("48 kB", image, 1)):
            rows.append(_cost(name, pool, fn, torch.zeros(K, 2), repeats))
        if task:
            start = catalogue.fitting(task).start(0)
            spread = torch.linspace(0, 1, points, dtype=start.dtype)[:, None] * start
            rows.append(_cost(task, pool, Factory(images_of, task), spread, max(1, repeats // 20)))
    return rows


def _cost(name: str, pool: ProcessPool, fn: Callable[[Tensor], Tensor], x: Tensor, repeats: int) -> Cost:
    inline = Inline()
    seconds, compared = in_turn(lambda: pool(fn, x), lambda: inline(fn, x), repeats)
    return Cost(name, pool.workers, len(x), seconds, compared)


class Hanging:
    """A black box that hangs once for every file in a folder."""

    def __init__(self, folder: str) -> None:
        self.folder = Path(folder)

    def __call__(self, x: Tensor) -> Tensor:
        """Return values [K] of x [K, n]."""
        for file in self.folder.iterdir():
            try:
                file.unlink()
            except FileNotFoundError:  # another worker hangs for this one
                continue
            time.sleep(3600)
        return (x**3).sin().sum(1)


def disturb(count: int, evaluations: int, kills: int, hangs: int, seed: int) -> Faults:
    """Evaluate in workers of which some are killed and some hang, and count the faults in the result."""
    resource_tracker.ensure_running()  # by multiprocessing, with a pipe, for as long as the interpreter lives
    before, start = _open_files(), time.monotonic()
    generator = torch.Generator().manual_seed(seed)
    x = torch.rand(evaluations, 3, generator=generator, dtype=torch.float64)
    calls, chance = x.split(_CALL), random.Random(seed)
    hanging = [chance.randrange(len(calls)) for _ in range(hangs)]
    different = lost = done = 0
    with tempfile.TemporaryDirectory() as folder, ProcessPool(count, timeout=1.0, retries=20) as pool:
        fn = Hanging(folder)
        due, killed_before = [0], [0]
        with _killer(kills, chance, due, killed_before) as killed:
            for k, part in enumerate(progress(calls, "disturbed calls")):
                for number in range(hanging.count(k)):
                    (Path(folder) / str(number)).touch()
                due[0] = kills * (k + 1) // len(calls)
                values = pool(fn, part)
                killed_before[0] = len(killed)
                different += int((values != (part**3).sin().sum(1)).sum())
                lost += len(pool.lost)
                while len(killed) < due[0]:  # as many as are due, then go on
                    if not _workers() or len(killed) >= killed_before[0] + _IN_A_ROW:  # until workers are made again
                        different += int((pool(fn, part[:count]) != (part[:count] ** 3).sin().sum(1)).sum())
                        killed_before[0] = len(killed)
                    time.sleep(0.01)
                done += len(values)
    left = _workers()
    files = len(_open_files() - before)
    return Faults(done, len(killed), hangs, different, lost, len(left), files, time.monotonic() - start)


def _workers() -> list[multiprocessing.process.BaseProcess]:
    """Return the worker processes that are alive."""
    return [one for one in multiprocessing.active_children() if one.name == "torch_zerohess worker"]


@contextmanager
def _killer(kills: int, chance: random.Random, due: list[int], killed_before: list[int]) -> Iterator[list[int]]:
    """Kill workers at random times, a few more than are due at most, and append the number of each.

    Where workers start slowly, they would all die before they begin, if kills did not keep step with calls.
    """
    killed: list[int] = []
    over = threading.Event()

    def kill() -> None:
        while len(killed) < kills and not over.wait(chance.expovariate(1.0)):
            if len(killed) >= min(due[0] + _EARLY, killed_before[0] + _IN_A_ROW):
                continue
            running = _workers()
            if running and (pid := chance.choice(running).pid) is not None and pid not in killed:
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

    thread = threading.Thread(target=kill, daemon=True)
    thread.start()
    try:
        yield killed
    finally:
        over.set()
        thread.join()


def _open_files() -> set[str]:
    """Return what this process has open, and the segments of shared memory; nothing where /proc is not."""
    found = set()
    for name in ("/proc/self/fd", "/dev/shm"):
        if Path(name).is_dir():
            found |= {f"{name}/{one}" for one in os.listdir(name)}
    return found
