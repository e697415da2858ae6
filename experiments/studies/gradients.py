"""`python -m experiments gradients`: derivatives by the renderer and by sampling, against the truth.

Truth is a narrow central difference of renders with many samples per pixel, whose noise is the same on both sides.
Each gradient is of the task's own render with few samples. Three measures of it are medians over repetitions with
other seeds: its cosine to the truth, its relative error, and its cosine to x - solution ("way"). If the cosine to x -
solution is 1, a step against the gradient leads straight to the solution. A gradient that is exactly zero has no
direction: its cosine is 0.

The loss may have ripples, on MUG one per degree from the facets of the handle. The exact derivative then leads astray.
A sampled derivative is the derivative of the smoothed loss. It is not the exact one, and may lead to the solution.
"""

import math
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.arguments import Tasks
from experiments.ensembles.kept_parts import KeptParts
from experiments.problems import catalogue
from experiments.problems.rendered import RenderedTask
from experiments.problems.scenes.adjoint import resolved
from experiments.problems.task import Preset
from experiments.reports.progress import progress
from experiments.reports.tables import Printer

POINTS = {"start": 1.0, "middle": 0.5, "near": 0.1}
"""Distance from the solution / distance of the start from the solution."""


@dataclass(frozen=True)
class GradientError:
    """How good one kind of gradient is at one point."""

    task: str
    point: str
    method: str
    evaluations: int
    truth: float
    """Length of the true gradient."""
    noise: float
    """Standard error of the truth over its length."""
    cosine: float
    error: float
    """Relative."""
    way: float
    """Cosine to x - solution."""
    milliseconds: float


def gradients(
    tasks: Tasks = ("mug", "shad", "bunny", "mirror"),
    /,
    repeats: int = 7,
    spp: int = 256,
    pairs: tuple[int, ...] = (1, 8),
    step: float = 0.01,
    sigma: float = 0.2,
    preset: Preset = "fast",
    variant: str = "auto",
    out: Path = Path("results/gradients"),
) -> list[GradientError]:
    """Compare derivatives of rendered tasks at the start of run 0, half-way and near the solution.

    Rows are printed and kept point by point; the same command goes on where it was stopped.

    Args:
        tasks: those that Mitsuba renders.
        repeats: gradients of each kind, with other seeds.
        spp: samples per pixel of the renders for the truth, of which there are four pairs per parameter.
        pairs: antithetic pairs of the sampled gradients.
        step: half the distance of the central differences, in units of the sigma of the task.
        sigma: of the sampled gradients, in the same units.
        preset: fast or paper.
        variant: of Mitsuba; without derivatives only sampled gradients are measured.
        out: folder of the rows, parts.jsonl.
    """
    if repeats < 1 or spp < 1 or min(pairs, default=0) < 1:
        raise SystemExit(f"repeats, spp and pairs must be at least 1, got {repeats}, {spp} and {pairs}")
    if not (step > 0 and sigma > 0):
        raise SystemExit(f"step and sigma must be above 0, got {step} and {sigma}")
    torch.set_num_threads(1)
    names = catalogue.chosen("tasks", tasks, list(catalogue.RENDERED))
    catalogue.check_variant(variant, names)
    kept, printer, found = KeptParts(out), Printer("derivatives against the truth", _HEADERS, _WIDTHS), []
    variant = resolved(variant)
    settings = {"repeats": repeats, "spp": spp, "pairs": list(pairs), "step": step, "sigma": sigma}
    for name in names:
        task = catalogue.load(name, preset, variant)
        assert isinstance(task, RenderedTask)
        reason = task.renderer.no_adjoint()
        if reason:
            print(f"{task.name}: {reason}")
        rulers = _Rulers(task, repeats, spp, pairs, step, sigma)
        for point in progress(POINTS, task.name, leave=False):
            part = {"task": task.name, "point": point, "preset": preset, "variant": variant, **settings}
            rows = kept.rows(part, GradientError, partial(rulers.measure, point))
            for row in rows:
                printer(_cells(row))
            found += rows
        task.renderer.release()  # a scene that stays loaded slows down the next
    print(f"\nkept in {out}")
    return found


_HEADERS = ["task", "point", "gradient", "evaluations", "true length", "noise", "cosine", "error", "way", "ms"]
_WIDTHS = [6, 6, 16, 0, 0, 0, 0, 5, 5, 5]


def _cells(one: GradientError) -> list[object]:
    return [
        *(one.task, one.point, one.method, one.evaluations, f"{one.truth:.2g}", f"{one.noise:.0%}"),
        *(f"{one.cosine:.2f}", f"{one.error:.2f}", f"{one.way:.2f}", f"{one.milliseconds:.0f}"),
    ]


@dataclass(frozen=True)
class _Rulers:
    """What the gradients of a task are measured with; loaded for the first point that is measured."""

    task: RenderedTask
    repeats: int
    spp: int
    pairs: tuple[int, ...]
    step: float
    sigma: float

    @cached_property
    def kinds(self) -> "list[tuple[str, Gradient, int]]":
        kinds = _kinds(self.task, self.pairs, self.sigma * self.task.sigma)
        for _, one, _ in kinds:
            one(self.task.start(0), 0)  # compiles
        return kinds

    @cached_property
    def precise(self) -> Callable[[Tensor], Tensor]:
        return _precise_loss(self.task, self.spp)

    def measure(self, point: str) -> Iterator[GradientError]:
        """Yield the errors of every kind of gradient at a point."""
        task = self.task
        kinds, precise = self.kinds, self.precise
        x = task.solution + POINTS[point] * (task.start(0) - task.solution)
        truth, noise = differences(precise, x, self.step * task.sigma)
        size, noise_size, way = float(truth.norm()), float(noise.norm() / truth.norm()), x - task.solution
        yield GradientError(task.name, point, "truth", 0, size, noise_size, 1.0, 0.0, _cosine(truth, way), math.nan)
        for name, one, evaluations in kinds:
            estimates, times = zip(*(_timed(one, x, seed) for seed in range(self.repeats)), strict=True)
            yield GradientError(
                *(task.name, point, name, evaluations, size, noise_size),
                statistics.median(_cosine(g, truth) for g in estimates),
                statistics.median(float((g - truth).norm()) / size for g in estimates),
                statistics.median(_cosine(g, way) for g in estimates),
                1e3 * statistics.median(times),
            )


Gradient = Callable[[Tensor, int], Tensor]
"""Of x [n] and a seed."""


def _kinds(task: RenderedTask, pairs: tuple[int, ...], sigma: float) -> list[tuple[str, Gradient, int]]:
    """Names, gradients and their evaluations."""
    adjoint = task.renderer.adjoint

    def rendered(integrator: str) -> Gradient:
        assert adjoint is not None
        return lambda x, seed: adjoint(x, integrator, seed)[1]

    def sampled(count: int) -> Gradient:
        return lambda x, seed: (
            zh.estimate(
                task.loss, x, zh.Smoothing(sigma=sigma, samples=count, order=1, baseline="none", seed=seed)
            ).gradient
        )

    integrators = () if task.renderer.no_adjoint() else task.renderer.adjoints
    return [
        *((one, rendered(one), 2) for one in integrators),
        *((f"sampled, {count} pairs", sampled(count), 2 * count) for count in pairs),
    ]


def _precise_loss(task: RenderedTask, spp: int) -> Callable[[Tensor], Tensor]:
    """Loss [K] of points [K, n] from renders with many samples; every call has noise of its own."""
    scene = task.scene(replace(task.setting, spp=spp))
    scene.noise = "call"

    def loss(x: Tensor) -> Tensor:
        images = scene(torch.cat([task.solution[None], x])).double()
        return (images[1:] - images[0]).square().mean((1, 2, 3))

    return loss


def differences(loss: Callable[[Tensor], Tensor], x: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Central differences [n] of loss(points [K, n]) at x [n], and their standard errors, from four calls."""
    offsets = step * torch.eye(len(x), dtype=x.dtype)
    found, calls = [], 4
    for _ in range(calls):
        above, below = loss(torch.cat([x + offsets, x - offsets])).chunk(2)
        found.append((above - below) / (2 * step))
    gradients = torch.stack(found)
    return gradients.mean(0), gradients.std(0) / math.sqrt(calls)


def _timed(gradient: Gradient, x: Tensor, seed: int) -> tuple[Tensor, float]:
    """Gradient and seconds."""
    began = time.perf_counter()
    return gradient(x, seed), time.perf_counter() - began


def _cosine(a: Tensor, b: Tensor) -> float:
    length = float(a.norm() * b.norm())
    return float(a @ b) / length if length > 0 else 0.0
