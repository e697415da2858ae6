"""What a memory adds to a training step, as a share of one render of MUG.

A step is forward and backward of a layer for 16 elements, two of them fresh. The layer without memory makes the same
evaluations. The black box is an affine map onto the pixels of MUG, which takes next to no time.
"""

import time
from collections.abc import Callable

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems import catalogue
from experiments.studies.bench_ratios import Ratio, in_turn

SIZES = ((1, False), (5, False), (1024, False), (1024, True))
"""Parameters, and whether each pixel depends on few of them."""
_EACH = 4
"""Parameters that a pixel depends on, where these are few."""
_PIXELS = (3, 48, 64)
_BATCH, _FRESH = 16, 2
_GOAL = 5.0
"""Steps that take as long as a render."""


def memory_ratios(evaluations: int, repeats: int) -> list[Ratio]:
    """Measure a step and a fit with so many evaluations in memory, against a render of MUG.

    Args:
        evaluations: that the memory holds.
        repeats: timings of which the median is reported.
    """
    mug = catalogue.fitting("mug")
    x = mug.start(0)[None]
    return [row for n, local in SIZES for row in _rows(n, local, evaluations, repeats, lambda: mug.loss(x))]


def _rows(n: int, local: bool, evaluations: int, repeats: int, render: Callable[[], object]) -> list[Ratio]:
    generator = torch.Generator().manual_seed(0)
    slope = torch.randn(n, *_PIXELS, generator=generator) / n**0.5
    if local:
        chosen = torch.rand(n, *_PIXELS, generator=generator).topk(_EACH, 0).indices
        slope = (n / _EACH) ** 0.5 * slope * torch.zeros_like(slope).scatter_(0, chosen, 1.0)

    def draw(z: Tensor) -> Tensor:
        return torch.tensordot(z.float(), slope, 1)

    points = torch.randn(evaluations, n, generator=generator)
    memory = zh.Memory(fresh=_FRESH, capacity=evaluations)
    memory.add(points, draw(points))
    start = time.perf_counter()
    memory.fit()
    fit = time.perf_counter() - start
    memory.add = lambda points, outputs: None  # type: ignore[method-assign]  # the step alone, without a new fit
    x = torch.zeros(_BATCH, n, requires_grad=True)
    references = draw(torch.randn(_BATCH, n, generator=generator))
    smoothing, head = zh.Smoothing(sigma=0.1, samples=1, baseline="none"), zh.heads.SquaredError()
    remembering = zh.BlackBox(draw, smoothing, head=head, memory=memory, value="smoothed")
    plain = zh.BlackBox(draw, smoothing, head=head, value="smoothed")

    def with_memory() -> object:
        return torch.autograd.grad(remembering(x, references).mean(), x)

    def without() -> object:
        return torch.autograd.grad(plain(x[:_FRESH], references[:_FRESH]).mean(), x)

    longer, shorter = in_turn(with_memory, without, repeats)
    one, _ = in_turn(render, without, repeats)
    added = max(longer - shorter, 1e-9)
    name = f"memory of {evaluations}{', local' if local else ''}"
    return [
        Ratio(f"{name}: a step against a render", n, _FRESH, added, one, _GOAL),
        Ratio(f"{name}: a fit against as many renders", n, evaluations, fit, evaluations * one, _GOAL),
    ]
