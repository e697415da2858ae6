"""One optimisation as it looks: the point after every iteration, and an animation of the pictures of these points."""

import dataclasses
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.problems.rendered import Reference, RenderedTask
from experiments.problems.task import Task
from experiments.reports.digits import significant
from experiments.runs.records import Outcome, Record

_GRID = 61
"""Points along the side of a map of the loss; odd, so that the middle is one of them."""
_BANDS = 12
_FIRST, _EACH, _ALL, _LAST = 700, 150, 4000, 2500
"""Milliseconds that the first frame stays, each at least, all together at least, and the last."""
_FINE, _SAMPLES = 128, 64
"""Pixels along the height and samples per pixel of a still picture, at least."""
_GAP, _LINE = 6, 18
"""Pixels between pictures, and of a line of text."""

Picture = Any
"""Of PIL."""


@dataclass(frozen=True)
class Trace:
    """A run and where it was: `points` has an x [n] for each of `records`, the start first."""

    task: Task
    method: str
    points: list[Tensor]
    records: list[Record]
    outcome: Outcome

    @property
    def error(self) -> list[float]:
        """Image error over that at the start, by row; NaN where it was not finite."""
        errors = [math.nan if one.image_error is None else one.image_error for one in self.records]
        return [one / (errors[0] or 1.0) for one in errors]

    def caption(self, row: int) -> str:
        """Return evaluations and image error of a row."""
        return f"{self.records[row].evaluations} evaluations, error {error_percent(self.error[row])}"


def error_percent(error: float) -> str:
    """Return an error, as a share of the error at the start, as text to two digits.

    Example:
        >>> error_percent(1.0), error_percent(0.0123), error_percent(2e-7), error_percent(0.0), error_percent(math.nan)
        ('100 %', '1.2 %', '< 0.001 %', '0 %', 'not finite')
    """
    if math.isnan(error):
        return "not finite"
    return "< 0.001 %" if 0 < error < 1e-5 else f"{significant(100 * error, 2)} %"


@dataclass(frozen=True)
class Look:
    """The pictures of points of a task, and the picture that is sought."""

    picture: Callable[[Tensor], Tensor]
    """[n] -> [h, w] or [h, w, 3] in [0, 1]."""
    target: Tensor


def look(task: Task, start: Tensor) -> Look | None:
    """Return pictures of a task, or a map of the loss if it has none but two parameters; None if there is neither."""
    if task.picture is not None:
        return Look(task.picture.of, task.picture.target())
    return _map(task, start) if task.n == 2 else None


def finer(task: Task, seen: Look) -> Look:
    """Return pictures with more pixels and less noise than the task has, where a renderer can make them."""
    if not isinstance(task, RenderedTask):
        return seen
    width, height = task.setting.film
    scale = max(1, -(-_FINE // height))
    film, spp = (scale * width, scale * height), max(_SAMPLES, task.setting.spp)
    setting = dataclasses.replace(task.setting, film=film, spp=spp)
    picture = Reference(task.scene, task.moving, setting, task.solution).picture
    return Look(picture, picture(task.solution))


def _map(task: Task, start: Tensor) -> Look:
    """Bands of equal loss, the point as a red disc; without bounds the map is around 0 and reaches past the start."""
    reach = 1.15 * float(start.abs().max())
    lower, upper = task.bounds or (torch.full((2,), -reach).double(), torch.full((2,), reach).double())
    steps = torch.linspace(0, 1, _GRID, dtype=torch.float64)
    grid = lower + (upper - lower) * torch.cartesian_prod(steps, steps)
    values = task.loss(grid)
    height = (values - values.min()) / (values.max() - values.min())
    shade = ((height**0.4 * _BANDS).floor() / _BANDS).clamp(0, 1).reshape(_GRID, _GRID)
    ground = (0.35 + 0.6 * shade).mT.flip(0)  # x0 to the right, x1 up
    ground = ground.repeat_interleave(2, 0).repeat_interleave(2, 1)[..., None].expand(-1, -1, 3)

    def picture(x: Tensor) -> Tensor:
        side = len(ground)
        place = ((x - lower) / (upper - lower)).clamp(0, 1) * (side - 1)
        rows, columns = torch.meshgrid(torch.arange(side), torch.arange(side), indexing="ij")
        inside = (columns - place[0]).square() + (side - 1 - rows - place[1]).square() <= 12
        return torch.where(inside[..., None], torch.tensor([0.85, 0.1, 0.1]).double(), ground)

    return Look(picture, picture(grid[values.argmin()]))


def shown_rows(found: Trace, count: int) -> list[int]:
    """Return at most `count` rows: the first, the last, and those between at equal ratios of their evaluations.

    Rows between that are at the same point as the row before are left out.
    """
    last = len(found.points) - 1
    moved = [0, *(k for k in range(1, last) if not torch.equal(found.points[k], found.points[k - 1]))]
    moved += [last] if last else []
    if len(moved) <= count:
        return moved
    at = np.array([max(found.records[row].evaluations, 1) for row in moved])
    wanted = (1 - 1e-9) * np.geomspace(at[0], at[-1], count)  # less the rounding
    chosen = np.minimum(np.searchsorted(at, wanted), len(at) - 1)
    return [moved[k] for k in sorted({0, *chosen[1:-1].tolist(), len(moved) - 1})]


def frames(found: Trace, seen: Look, rows: Sequence[int], height: int) -> list[Picture]:
    """Return a picture for each row: the point beside the target, with a line below."""
    target = tile(seen.target, height)
    return [
        captioned(
            [tile(seen.picture(found.points[row]), height), target],
            f"{found.task.name.upper()}, {found.method}",
            found.caption(row),
        )
        for row in rows
    ]


def tile(picture: Tensor, height: int) -> Picture:
    """Return a picture [h, w] or [h, w, 3] in [0, 1] for PIL, each pixel a square of some, about `height` high."""
    from PIL import Image

    image = Image.fromarray(pixels(picture))
    scale = max(1, round(height / image.height))
    return image.resize((scale * image.width, scale * image.height), Image.Resampling.NEAREST)


def pixels(picture: Tensor) -> np.ndarray[Any, np.dtype[np.uint8]]:
    """Return bytes [h, w, 3] of a picture [h, w] or [h, w, 3]; numbers are clipped to [0, 1]."""
    found = (255 * picture.detach().double().clamp(0, 1)).round().to(torch.uint8)
    return np.ascontiguousarray((found if found.ndim == 3 else found[..., None].expand(-1, -1, 3)).numpy())


def captioned(tiles: Sequence[Picture], title: str, footer: str) -> Picture:
    """Return tiles side by side, with a line above and one below."""
    from PIL import Image, ImageDraw

    width = sum(one.width for one in tiles) + _GAP * (len(tiles) - 1)
    height = max(one.height for one in tiles)
    canvas = Image.new("RGB", (width, height + 2 * _LINE), "white")
    left = 0
    for one in tiles:
        canvas.paste(one, (left, _LINE))
        left += one.width + _GAP
    draw = ImageDraw.Draw(canvas)
    draw.text((2, 1), title, "black", _font())
    draw.text((2, _LINE + height + 1), footer, "black", _font())
    return canvas


def together(columns: Sequence[Sequence[Picture]], across: int) -> list[Picture]:
    """Return one sequence of frames that shows several at once, `across` in a row; a shorter one stays at its last."""
    from PIL import Image

    longest = max(len(one) for one in columns)
    width = max(frame.width for one in columns for frame in one) + 2 * _GAP
    height = max(frame.height for one in columns for frame in one) + _GAP
    size = (across * width, -(-len(columns) // across) * height)
    found = []
    for k in range(longest):
        canvas = Image.new("RGB", size, "white")
        for i, one in enumerate(columns):
            canvas.paste(one[min(k, len(one) - 1)], (i % across * width + _GAP, i // across * height))
        found.append(canvas)
    return found


def save(images: Sequence[Picture], path: Path) -> Path:
    """Write an animation, as WebP if PIL can, else as GIF; returns the path with its suffix."""
    from PIL import features

    each = max(_EACH, _ALL // len(images))
    times = [_FIRST, *[each] * (len(images) - 2), _LAST][-len(images) :]
    webp = bool(features.check("webp"))
    path = path.with_suffix(".webp" if webp else ".gif")
    more = {"quality": 80, "method": 4} if webp else {"optimize": True}
    images[0].save(path, save_all=True, append_images=list(images[1:]), duration=times, loop=0, **more)
    return path


@lru_cache(maxsize=1)
def _font() -> Any:
    """Return the font that matplotlib ships, so that pictures look the same everywhere."""
    from matplotlib import font_manager
    from PIL import ImageFont

    return ImageFont.truetype(font_manager.findfont("DejaVu Sans"), 13)
