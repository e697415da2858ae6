"""A task as pictures under several losses, and its two smoothed objectives: E L(f) and L(E f), f at x + sigma u."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.problems.task import Output, Task
from experiments.problems.tasks import brdf
from torch_zerohess.losses import ImageLoss

FACTORIES: Mapping[str, Callable[[Tensor], ImageLoss]] = {
    "mse": zh.losses.mse,
    "multiscale_mse": zh.losses.multiscale_mse,
    "ssim": zh.losses.ssim,
}
FORMS = ("inside", "image")
"""E L(f), the loss inside the black box, and L(E f), after a black box that returns the image."""
_CHUNK = 8  # pictures compared at a time: they stay in the cache
_BATCH = 64  # pictures rendered at a time


@dataclass(frozen=True)
class Moments:
    """E f and E L(f) at a point, with their derivatives: what both objectives are made of."""

    picture: Tensor
    """[*picture]"""
    slopes: Tensor
    """[n, *picture]"""
    values: Tensor
    """[L]"""
    value_slopes: Tensor
    """[n, L]"""

    @classmethod
    def mean(cls, parts: Sequence["Moments"]) -> "Moments":
        """Average moments from samples of equal size."""
        names = ("picture", "slopes", "values", "value_slopes")
        return cls(*(torch.stack([getattr(part, name) for part in parts]).mean(0) for name in names))


@dataclass(frozen=True)
class Pictures:
    """A task whose image is a picture, and L losses against its target."""

    task: Task
    render: Callable[[Tensor], Tensor]
    """[K, n] -> [K, h, w] or [K, h, w, 3]."""
    losses: dict[str, ImageLoss]

    def values(self, pictures: Tensor) -> Tensor:
        """Losses [K, L] of pictures, compared in single precision."""
        parts = pictures.float().split(_CHUNK)
        return torch.cat([torch.stack([loss(part) for loss in self.losses.values()], 1) for part in parts]).double()

    def objective(self, moments: Moments, form: str) -> tuple[Tensor, Tensor]:
        """Values [L] and gradients [L, n] of the smoothed objectives in one of `FORMS`."""
        if form == "inside":
            return moments.values, moments.value_slopes.mT
        found = [torch.func.grad_and_value(loss)(moments.picture) for loss in self.losses.values()]
        downhill = torch.stack([gradient.flatten() for gradient, _ in found])
        return torch.stack([value for _, value in found]), downhill @ moments.slopes.flatten(1).mT

    def moments(self, x: Tensor, sigma: float, u: Tensor) -> Moments:
        """Stein's identities written out, for standard normal u [K, n] and -u; the baseline is f(x)."""
        base = self.render(x[None])
        base_values = self.values(base)
        sums: list[Any] = [0.0, 0.0, 0.0, 0.0]
        for part in torch.cat([u, -u]).split(_BATCH):
            pictures = self.render(x + sigma * part)
            change, value_change = pictures - base, self.values(pictures) - base_values
            new = (change.sum(0), torch.tensordot(part.mT, change, 1), value_change.sum(0), part.mT @ value_change)
            sums = [old + one for old, one in zip(sums, new, strict=True)]
        picture, slopes, values, value_slopes = (one / (2 * len(u)) for one in sums)
        return Moments(base[0] + picture, slopes / sigma, base_values[0] + values, value_slopes / sigma)

    def estimate(self, x: Tensor, smoothing: zh.Smoothing) -> Moments:
        """Return the estimates of the package, all from one batch of evaluations."""

        def fn(points: Tensor) -> Tensor:
            pictures = self.render(points)
            return torch.cat([pictures.flatten(1), self.values(pictures)], 1)

        found = zh.estimate(fn, x, smoothing, value="smoothed")
        shape, count = self.render(x[None]).shape[1:], len(self.losses)
        value, gradient = found.value, found.gradient.mT
        return Moments(
            value[:-count].view(shape),
            gradient[:, :-count].reshape(-1, *shape),
            value[-count:],
            gradient[:, -count:],
        )

    def with_loss(self, name: str, evaluations: int) -> Task:
        """Return the task with another loss, in both forms, and as many evaluations."""
        loss, render = self.losses[name], self.render

        def inside(x: Tensor) -> Tensor:
            return torch.cat([loss(part) for part in render(x).split(_CHUNK)])

        return replace(self.task, loss=inside, output=Output(render, loss), evaluations=evaluations)


def pictures_of(task: Task) -> Pictures:
    """Return a task as pictures; SystemExit if its image is none."""
    if task.output is None or task.output.residuals is None or task.picture is None:
        raise SystemExit(f"tasks must be some whose image is a picture, got {task.name}")
    render = task.output.image
    start, shape = render(task.start(0)[None]), task.picture.of(task.start(0)).shape
    target = start - task.output.residuals(start[0]).view_as(start)
    if task.name == "brdf":  # its image is the pixels of the sphere alone
        mask, pixels = brdf.PhongSphere(shape[0]).mask, task.output.image

        def render(x: Tensor) -> Tensor:
            return _filled(pixels(x), mask)

        target = _filled(target, mask)
    if target.shape[1:3] != shape[:2]:
        raise SystemExit(f"tasks must be some whose image is a picture, got {task.name} with {list(target.shape[1:])}")
    return Pictures(task, render, {name: make(target[0]) for name, make in FACTORIES.items()})


def normal(count: int, n: int, seed: int) -> Tensor:
    """Scrambled Sobol points [count, n] of the standard normal distribution."""
    points = torch.quasirandom.SobolEngine(n, scramble=True, seed=seed).draw(count, dtype=torch.float64)
    return torch.special.ndtri(points.clamp(1e-12, 1 - 1e-12))


def _filled(pixels: Tensor, mask: Tensor) -> Tensor:
    """Pixels [K, M, 3] -> pictures [K, h, w, 3], black beside the mask [h, w]."""
    pictures = pixels.new_zeros(len(pixels), *mask.shape, 3)
    pictures[:, mask] = pixels
    return pictures
