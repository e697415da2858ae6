"""A task in other circumstances: another start, fewer samples per pixel, fresh noise, a compressed reference.

The black box changes, the errors do not: the image error of a run is always the image error of the unchanged task, with
its samples per pixel, its seed and its clean reference. So rows of different circumstances can be compared, and a run
with noise or with a compressed reference can end at an error of 0.
"""

import dataclasses
import io
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Literal, get_args

import numpy as np
import torch
from torch import Tensor

from experiments.problems import catalogue
from experiments.problems.rendered import Reference, RenderedTask, Setting
from experiments.problems.srgb import from_srgb, to_srgb
from experiments.problems.task import Output, Preset, Task

Noise = Literal["fixed", "other", "call", "point"]
"""Seed of the renders: the seed of the reference, another one, a new one for every call, or one for every point."""


@dataclass(frozen=True)
class Change:
    """What differs from the task; nothing by default."""

    start: float = 1.0
    """Distance of the start from the solution / the same distance in the task."""
    pairs: int | None = None
    """Antithetic pairs of the method, if not its own setting."""
    spp: float = 1.0
    """Samples per pixel / samples of the task, in the renders and in the reference; at least one sample."""
    noise: Noise = "fixed"
    jpeg: int | None = None
    """Quality of the reference, 1 to 100, if it is compressed."""

    def __post_init__(self) -> None:
        for name, value in (("start", self.start), ("spp", self.spp)):
            if not value > 0:
                raise ValueError(f"{name} must be a positive factor, got {value}")
        if self.noise not in get_args(Noise):
            raise ValueError(f"noise must be one of {', '.join(get_args(Noise))}, got {self.noise}")
        if self.pairs is not None and self.pairs < 1:
            raise ValueError(f"pairs must be at least 1, got {self.pairs}")
        if self.jpeg is not None and not 1 <= self.jpeg <= 100:
            raise ValueError(f"jpeg must be a quality of 1 to 100, got {self.jpeg}")

    def __str__(self) -> str:
        """Return what differs: "spp=0.25 noise=point"."""
        given = {field.name: (getattr(self, field.name), field.default) for field in dataclasses.fields(self)}
        return " ".join(f"{name}={value}" for name, (value, default) in given.items() if value != default)

    @property
    def rendered(self) -> bool:
        """Whether it needs a renderer."""
        return (self.spp, self.noise, self.jpeg) != (1.0, "fixed", None)


@dataclass(frozen=True, kw_only=True)
class Varied(Task):
    """A task that is pickled as the arguments of `load`."""

    made: tuple[str, Preset, str, int | None, Change]

    def __reduce__(self) -> tuple[Callable[..., Task], tuple[Any, ...]]:
        return load, self.made


def load(name: str, preset: Preset, variant: str, evaluations: int | None, change: Change) -> Task:
    """Return a task of the catalogue, changed.

    A scene stays loaded for the next run of the process, unless its noise is fresh: its seeds go on from call to call,
    and a run must not depend on the runs before it.

    Args:
        name: of the task.
        preset: of it.
        variant: of Mitsuba.
        evaluations: of a run, at most; the number of the task if None.
        change: what differs; ValueError if the task cannot be changed in this way.
    """
    if change.noise in ("fixed", "other"):
        return _kept(name, preset, variant, evaluations, change)
    _kept.cache_clear()
    return _load(name, preset, variant, evaluations, change)


def _load(name: str, preset: Preset, variant: str, evaluations: int | None, change: Change) -> Varied:
    task = varied(_base(name, preset, variant), change)
    facts = {field.name: getattr(task, field.name) for field in dataclasses.fields(Task)}
    facts["evaluations"] = evaluations or task.evaluations
    return Varied(**facts, made=(name, preset, variant, evaluations, change))


_kept = lru_cache(maxsize=1)(_load)  # scenes that stay loaded slow down the next


@lru_cache(maxsize=1)
def _base(name: str, preset: Preset, variant: str) -> Task:
    return catalogue.fitting(name, preset, variant)


def varied(task: Task, change: Change) -> Task:
    """Return the task, changed; its name says how. ValueError if it cannot be changed in this way."""
    name = f"{task.name} {change}".strip()
    if change.start != 1.0:
        task = _moved(task, change.start)
    if change.rendered:
        task = _rendered_otherwise(task, change)
    return dataclasses.replace(task, name=name)


def _moved(task: Task, factor: float) -> Task:
    solution, start = _rendered(task, "its solution is not a point").solution, task.start
    return dataclasses.replace(task, start=lambda run: torch.lerp(solution, start(run), factor))


def _rendered_otherwise(task: Task, change: Change) -> Task:
    made = _rendered(task, "it is not rendered")
    spp = max(1, round(change.spp * made.setting.spp))
    setting = dataclasses.replace(made.setting, spp=spp)
    compress = None if change.jpeg is None else lambda image: jpeg(image, change.jpeg or 0)
    reference = VariedReference(made, setting, change.noise, compress)

    def prepare() -> None:
        reference.prepare()
        made.renderer.prepare()

    def release() -> None:
        reference.release()
        made.renderer.release()

    return dataclasses.replace(
        task,
        loss=reference.loss,
        output=Output(reference.image, reference.loss_of, reference.residuals),
        # The derivative is left out: it belongs to the unchanged task.
        renderer=dataclasses.replace(
            made.renderer, adjoint=None, prepare=prepare, release=release, skip=reference.skip
        ),
    )


def _rendered(task: Task, reason: str) -> RenderedTask:
    if not isinstance(task, RenderedTask):
        raise ValueError(f"task cannot be changed in this way, {task.name}: {reason}")
    return task


class VariedReference(Reference):
    """A reference that differs from a render of the solution: by noise, by samples, or by compression.

    Args:
        task: whose scene it is.
        setting: of its renders.
        noise: of the renders; the reference has the first seed.
        change: what happens to the reference [h, w, 3], if anything.
    """

    def __init__(
        self,
        task: RenderedTask,
        setting: Setting,
        noise: Noise = "fixed",
        change: Callable[[Tensor], Tensor] | None = None,
    ) -> None:
        super().__init__(task.scene, task.moving, setting, task.solution)
        self._noise, self._change = noise, change

    @cached_property
    def target(self) -> Tensor:
        """[h, w, 3]."""
        clean = super().target
        if self._noise == "other":
            self.scene.noise = "call"
            self.scene(self.solution[None][:0])  # goes on to the next seed, which is then kept
            self.scene.noise = "fixed"
        else:
            self.scene.noise = self._noise
        return clean if self._change is None else self._change(clean)

    def image(self, x: Tensor) -> Tensor:
        self.prepare()  # the target is rendered before the noise becomes another
        return super().image(x)

    def skip(self, calls: int, points: int) -> None:
        """See `Renderer.skip`."""
        self.prepare()
        self.scene.skip(calls, points)


def jpeg(image: Tensor, quality: int) -> Tensor:
    """Return a linear image [h, w, 3] as it comes back from an 8-bit sRGB JPEG file; above 1 it is clipped."""
    from PIL import Image

    file = io.BytesIO()
    Image.fromarray(to_srgb(image)).save(file, "JPEG", quality=quality)
    return from_srgb(torch.from_numpy(np.array(Image.open(file))))
