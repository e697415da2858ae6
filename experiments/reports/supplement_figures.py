"""Figures of the source's supplement that show runs.

Known derivatives (7, 8), all tasks (9), the caustic (12) and the two mirrors (13).
"""

import io
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from matplotlib.figure import Figure
from torch import Tensor

from experiments.problems.scenes.bunny import IN_MIRRORS, in_mirrors
from experiments.problems.scenes.caustic import COEFFICIENTS, basis
from experiments.problems.scenes.parts import rgb
from experiments.problems.srgb import shown
from experiments.reports.animation import Look, Trace, pixels
from experiments.reports.error_curves import AXES, band, levels, plain_ticks
from experiments.reports.results import Run
from torch_zerohess.adapters.mitsuba import MitsubaScene

_COLORS = 256
"""Of a sheet: enough for its pictures, for a third of the size."""

_ACROSS = 8
"""Tasks in a row of an overview, at most."""
_WAY = ((1.5, 0.0, 2.2), (1.5, 0.0, -0.6), (-1.2, 0.0, -0.6), (-1.2, 0.0, -2.4))
"""From the eye to the bunny of MIRROR."""


@dataclass(frozen=True)
class Column:
    """A task in the overview: pictures [h, w] or [h, w, 3] in [0, 1] at the start, at the end, and of the target."""

    task: str
    method: str
    start: Tensor
    end: Tensor
    target: Tensor
    caption: str
    """Of the end."""

    @classmethod
    def of(cls, found: Trace, seen: Look) -> "Column":
        """Return the column of a run on a fitting task."""
        start, end = (seen.picture(found.points[k]) for k in (0, -1))
        return cls(found.task.name, found.method, start, end, seen.target, found.caption(-1))


def overview(shown: Sequence[Column], path: Path) -> None:
    """Draw figure 9: a column per task, with its start, the end of the run, and the target."""
    bands = -(-len(shown) // _ACROSS)
    across = -(-len(shown) // bands)
    figure = Figure(figsize=(1.35 * across + 0.4, 4.3 * bands), layout="constrained")
    methods = {one.method for one in shown}
    method = methods.pop() if len(methods) == 1 else None
    for k, part in enumerate(figure.subfigures(bands, 1, squeeze=False)[:, 0]):
        _band(part, shown[k * across : (k + 1) * across], across, method)
    save_small(figure, path)


def _band(figure: Any, shown: Sequence[Column], across: int, method: str | None) -> None:
    """Draw `across` columns; `method` is the method of all runs, None if there are several."""
    axes = figure.subplots(3, across, squeeze=False)
    for axis in axes[:, len(shown) :].flat:
        axis.axis("off")
    for column, one in zip(axes.T, shown, strict=False):
        for axis, picture in zip(column, (one.start, one.end, one.target), strict=True):
            _picture(axis, picture)
        column[0].set_title(one.task.upper(), fontsize=9)
        text = one.caption if method else f"{one.method}, {one.caption}"
        column[1].set_xlabel(text.replace(", ", "\n"), fontsize=6.5)
    for axis, name in zip(axes[:, 0], ("start", method or "end", "target"), strict=True):
        axis.set_ylabel(name, fontsize=10)


def descents(groups: Mapping[str, Sequence[Trace]], path: Path) -> None:
    """Draw figures 7 and 8: errors of an ensemble and, where a task has two parameters, trajectories over its loss.

    groups: runs on one task, by what they have in common; dashed where the name begins with "first".
    """
    task = next(iter(groups.values()))[0].task
    planes = list(groups) if task.n == 2 else []
    figure = Figure(figsize=(3.1 * len(planes) + 9, 3.6), layout="constrained")
    axes: Any = figure.subplots(1, len(planes) + 2, width_ratios=[1.0] * len(planes) + [1.4, 1.4], squeeze=False)[0]
    colors = {name: f"C{k}" for k, name in enumerate(groups)}
    for axis, name in zip(axes, planes, strict=False):
        _trajectories(axis, groups[name], colors[name])
        axis.set_title(name, fontsize=9)
    for axis, (against, label) in zip(axes[len(planes) :], AXES.items(), strict=True):
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel="error / at the start: median, quartiles")
        for name, found in groups.items():
            style = {"color": colors[name], "linestyle": "--" if name.startswith("first") else "-"}
            band(axis, [Run(one.outcome, one.records) for one in found], "image", against, name, style)
        axis.grid(which="major", alpha=0.3)
        plain_ticks(axis)
    axes[-1].legend(fontsize=8, frameon=False)
    figure.suptitle(f"{task.name.upper()}: {len(next(iter(groups.values())))} starts", fontsize=11)
    save_small(figure, path)


def _trajectories(axis: Any, found: Sequence[Trace], color: str) -> None:
    """Draw the trajectories of runs over contours of the loss."""
    task = found[0].task
    places = torch.cat([torch.stack(one.points) for one in found])
    low, high = task.bounds or (places.amin(0), places.amax(0))
    grid = [torch.linspace(float(a), float(b), 81, dtype=torch.float64) for a, b in zip(low, high, strict=True)]
    values = task.loss(torch.cartesian_prod(*grid)).reshape(81, 81).mT.numpy()
    axis.contourf(grid[0].numpy(), grid[1].numpy(), values, levels=12, cmap="Greys", alpha=0.6)
    for one in found:
        points = torch.stack(one.points).numpy()
        axis.plot(points[:, 0], points[:, 1], "-", color=color, linewidth=0.8, alpha=0.8)
        axis.plot(points[0, 0], points[0, 1], ".", color=color, markersize=4)
    axis.set(xlim=(float(low[0]), float(high[0])), ylim=(float(low[1]), float(high[1])), aspect="equal")


def caustic(found: Trace, seen: Look, other: Trace | None, path: Path) -> None:
    """Draw figure 12: pictures that the slab throws above its surface, and errors; with `other` for comparison."""
    runs = [found, *([other] if other else [])]
    columns = [("start", found.points[0], found.caption(0))]
    columns += [(one.method, one.points[-1], one.caption(-1)) for one in runs]
    figure = Figure(figsize=(2.2 * (len(columns) + 1) + 3.6, 4.9), layout="constrained")
    parts: Any = figure.subfigures(1, 2, width_ratios=[2.2 * (len(columns) + 1), 3.6])
    left, right = parts
    axes = left.subplots(2, len(columns) + 1)
    largest = max(float((_surface(x) - _surface(x).mean()).abs().max()) for _, x, _ in columns)
    for (top, below), (name, x, text) in zip(axes.T, columns, strict=False):
        _picture(top, seen.picture(x))
        top.set_title(name, fontsize=10)
        top.set_xlabel(text.replace(", ", "\n"), fontsize=8)
        below.imshow((_surface(x) - _surface(x).mean()).numpy(), cmap="RdBu", vmin=-largest, vmax=largest)
        below.set(xticks=[], yticks=[])
        below.set_xlabel("surface", fontsize=8)
    _picture(axes[0][-1], seen.target)
    axes[0][-1].set_title("target", fontsize=10)
    axes[1][-1].axis("off")
    _errors(right.subplots(), runs)
    save_small(figure, path)


def mirrors(found: Trace, seen: Look, experiment: Tensor, path: Path) -> None:
    """Draw figure 13: the experiment from outside [h, w, 3], start, end and target, and the error."""
    panels = [
        ("experiment", experiment, ""),
        ("start", seen.picture(found.points[0]), found.caption(0)),
        (found.method, seen.picture(found.points[-1]), found.caption(-1)),
        ("target", seen.target, ""),
    ]
    widths = [1.5, 1, 1, 1, 1.5]
    figure = Figure(figsize=(12.4, 2.9), layout="constrained")
    axes = figure.subplots(1, 5, width_ratios=widths)
    for axis, (name, picture, text) in zip(axes, panels, strict=False):
        _picture(axis, picture)
        axis.set_title(name, fontsize=10)
        axis.set_xlabel(text.replace(", ", "\n"), fontsize=8)
    _errors(axes[-1], [found])
    save_small(figure, path)


def mirrors_from_outside(variant: str, film: tuple[int, int] = (240, 180), spp: int = 64) -> Tensor:
    """Render the scene of MIRROR from above, with a line from the eye by both mirrors to the bunny: sRGB [h, w, 3]."""

    def scene(mi: Any) -> dict[str, Any]:
        found = in_mirrors(mi)
        view = mi.ScalarTransform4f().look_at(origin=[2.2, 6.5, -4.5], target=[0.2, -0.3, -0.4], up=[0, 1, 0])
        red = {"type": "diffuse", "reflectance": rgb(0.8, 0.05, 0.05)}
        grey = {"type": "diffuse", "reflectance": rgb(0.35)}
        floor = mi.ScalarTransform4f().translate([0, -1.55, 0]).rotate([1, 0, 0], -90).scale(30)
        line = {
            f"line{k}": {"type": "cylinder", "p0": list(a), "p1": list(b), "radius": 0.02, "bsdf": red}
            for k, (a, b) in enumerate(itertools.pairwise(_WAY))
        }
        return {
            **found,
            **line,
            "sensor": {**found["sensor"], "to_world": view, "fov": 44.0},
            "eye": {"type": "sphere", "center": list(_WAY[0]), "radius": 0.12, "bsdf": red},
            "floor": {"type": "rectangle", "to_world": floor, "bsdf": grey},
        }

    made = MitsubaScene(scene, [IN_MIRRORS], film=film, spp=spp, depth=6, variant=variant, threads=1)
    return shown(made(torch.zeros(1, 3).double())[0])


def save_small(figure: Any, path: Path) -> None:
    """Write a figure as a PNG with a palette."""
    from PIL import Image

    file = io.BytesIO()
    figure.savefig(file, dpi=100, format="png")
    with Image.open(file) as image:
        image.convert("RGB").quantize(_COLORS, kmeans=1, dither=Image.Dither.NONE).save(path, optimize=True)


def _picture(axis: Any, picture: Tensor) -> None:
    axis.imshow(pixels(picture), interpolation="nearest")
    axis.set(xticks=[], yticks=[])


def _errors(axis: Any, runs: Sequence[Trace]) -> None:
    """Image error over that at the start, against evaluations; nothing of a run that never reported a point."""
    for one in runs:
        rows = [(record.evaluations, error) for record, error in zip(one.records, one.error, strict=True)][1:]
        if rows:
            axis.step(*zip(*rows, strict=True), where="post", label=one.method)
    levels(axis)
    axis.set(xscale="log", yscale="log", xlabel="evaluations", ylabel="image error / at the start")
    if axis.get_legend_handles_labels()[0]:
        axis.legend(fontsize=8, frameon=False)
    plain_ticks(axis)


def _surface(x: Tensor) -> Tensor:
    """Heights of the slab of CAUSTIC on a fine grid, in the units of its coefficients x [1024]."""
    splines = basis(torch.linspace(0, 1, 128, dtype=torch.float64))
    return splines @ x.reshape(COEFFICIENTS, COEFFICIENTS) @ splines.mT
