"""Steps of training through a memory, with all that it does: fits of its surrogate, and thinning beyond its capacity.

A linear network with two outputs is trained by Adam through a black box that rounds, which takes next to no time. The
time of a step is forward, backward and the step of Adam, of the processor.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import astuple, dataclass

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.reports import result_files

_BATCH, _FRESH = 16, 2
HEADERS = ("layer", "evaluations per step", "steps", "median [ms]", "mean [ms]", "longest [ms]")
LAYERS: dict[str, Callable[[], zh.Memory | None]] = {
    "no memory": lambda: None,
    f"memory, {_FRESH} of {_BATCH} elements fresh": lambda: zh.Memory(fresh=_FRESH),
    "memory, all elements fresh": zh.Memory,
}


@dataclass(frozen=True)
class Steps:
    """Times of some steps of training, in milliseconds."""

    layer: str
    evaluations: int
    """Of a step."""
    steps: str
    median: float
    mean: float
    longest: float


def memory_steps(ends: tuple[int, ...] = (400, 4000), seed: int = 0, store: str | None = None) -> list[Steps]:
    """Print the time of steps of training through a layer without a memory, and with two kinds of it.

    Args:
        ends: the last steps of the parts of training whose times are told.
        seed: of the network and of the samples.
        store: name under which the table is kept.
    """
    result_files.may_keep(store)
    torch.set_num_threads(1)
    rows = [row for name, memory in LAYERS.items() for row in measured(name, memory(), ends, seed)]
    result_files.show(HEADERS, [list(astuple(row)) for row in rows], store)
    return rows


def measured(name: str, memory: zh.Memory | None, ends: tuple[int, ...], seed: int) -> list[Steps]:
    """Return the times of all parts of training through a memory, or none."""
    torch.manual_seed(seed)
    network, inputs, references = torch.nn.Linear(5, 2), torch.randn(256, 5), torch.rand(256, 2)
    smoothing, head = zh.Smoothing(sigma=0.3, samples=1), zh.heads.SquaredError()
    layer = zh.BlackBox(_rounded, smoothing, head=head, memory=memory)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
    fresh = _BATCH if memory is None or memory.fresh is None else memory.fresh
    times = []
    for _ in range(ends[-1]):
        some = torch.randint(len(inputs), (_BATCH,))
        start = time.process_time()
        optimizer.zero_grad()
        layer(network(inputs[some]), references[some]).mean().backward()
        optimizer.step()
        times.append(1e3 * (time.process_time() - start))
    parts = []
    for first, last in zip((0, *ends), ends, strict=False):
        part = times[first:last]
        told = (statistics.median(part), statistics.mean(part), max(part))
        parts.append(Steps(name, fresh * smoothing.evaluations(2), f"{first + 1} to {last}", *told))
    return parts


def _rounded(z: Tensor) -> Tensor:
    return (4.0 * z).round() / 4.0
