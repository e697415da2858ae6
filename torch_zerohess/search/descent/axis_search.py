"""A search along the axes, for losses that are sums of functions of one parameter each.

Such a loss may have as many minima as the product of the minima along its axes, and quadratics find one at a time.
Two evaluations show whether the loss is a sum: where c and d are two points a and b with some coordinates exchanged,
f(a) + f(b) = f(c) + f(d). Then every parameter is searched alone, all of them in one batch. The interval that needs the
least curvature to contain a lower value is halved (STEP: Langerman, Seront and Bersini 1994). The lowest places of all
axes together are the lowest point, and quadratics begin there.
"""

import math
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated

_SUM = 1e-5
"""Largest difference of the two sums, over the smallest change of the loss between the points."""
_CHORD = 5
"""Points on the line through two points, from which a loss of one minimum is known."""
_PLACES = 40
"""Places that are evaluated on every axis before quadratics begin at the lowest ones."""
_LOWER, _AS_LOW = 1e-4, 1e-6
"""Decrease that is sought in an interval, and decrease that counts at a place, over the range of an axis's values."""
_FURTHER = ("lower", "level")
"""Stages after which further places may be lower."""


@dataclass(frozen=True, eq=False, kw_only=True)
class AxisLines:
    """The loss along the axes through a point."""

    origin: Best
    """Where the axes cross."""
    other: Tensor
    """A point with other coordinates [n], whose coordinates are exchanged with those of the origin."""
    other_loss: float
    stage: Literal["exchanged", "chord", "axes", "convex", "lower", "level", "over"] = "exchanged"
    """What is asked for: points with exchanged coordinates, points on a chord, or one point on every axis. Or what was
    found: a convex sum; something lower on the axes; nothing lower; or that the loss is no sum."""
    before: Tensor
    """The best point when the places were last asked for [n]."""
    places: Tensor
    """Coordinates along the axes [n, m]."""
    changes: Tensor
    """Loss there minus the loss at the origin [n, m]."""
    until: int = 0
    """Places on every axis that are to be known."""

    @property
    def asks(self) -> bool:
        """Whether it waits for values."""
        return self.stage in ("exchanged", "chord", "axes")

    @property
    def lowest(self) -> Tensor:
        """The lowest places of the axes; the coordinates of the best point where nothing is lower [n]."""
        least, k = self.changes.min(1)
        at_best = self.changes.gather(1, (self.places - self.before[:, None]).abs().argmin(1, keepdim=True))[:, 0]
        lower = at_best - least > _AS_LOW * (self.changes.amax(1) - least)
        return torch.where(lower, self.places.gather(1, k[:, None])[:, 0], self.before)

    @property
    def spacing(self) -> float:
        """Mean distance of the lowest places from the next ones."""
        apart = (self.places - self.lowest[:, None]).abs()
        return float(apart.masked_fill(apart == 0.0, math.inf).amin(1).mean())

    def adding(self, evaluated: Evaluated) -> "AxisLines":
        """Add points [K, n], one on every axis in turn. A loss that is not finite counts as the highest one."""
        n, count = len(self.places), len(evaluated)
        numbers = torch.arange(count, device=self.places.device)
        places, missing = evaluated.points[numbers, numbers % n], -count % n
        losses = torch.where(evaluated.finite, evaluated.losses, math.nan) - self.origin.loss
        if missing:  # the evaluations have ended: repeat what is known
            places = torch.cat([places, self.places[-missing:, 0]])
            losses = torch.cat([losses, self.changes[-missing:, 0]])
        changes = torch.cat([self.changes, losses.reshape(-1, n).mT], 1)
        highest = changes.nan_to_num(nan=-math.inf).amax(1, keepdim=True)
        changes = torch.where(changes.isnan(), highest, changes)
        return replace(self, places=torch.cat([self.places, places.reshape(-1, n).mT], 1), changes=changes)

    def middles(self, count: int) -> Tensor:
        """Return the middles of the intervals that need the least curvature to contain something lower [count, n]."""
        places, order = self.places.sort(1)
        changes = self.changes.gather(1, order)
        least, most = changes.amin(1, keepdim=True), changes.amax(1, keepdim=True)
        roots = (changes - least + _LOWER * (most - least)).sqrt()
        width = places[:, 1:] - places[:, :-1]
        needed = torch.where(width > 0.0, (roots[:, 1:] + roots[:, :-1]) / width, math.inf)
        easiest = needed.argsort(1)[:, :count]
        return (places[:, :-1] + 0.5 * width).gather(1, easiest).mT

    def on_axes(self, places: Tensor) -> Tensor:
        """Return the points [k n, n] at places [k, n] on the axes."""
        axes = torch.eye(len(self.places), dtype=torch.bool, device=places.device)
        return torch.where(axes, places[:, None, :], self.origin.point).flatten(0, 1)


class AxisSearch:
    """A search along the axes of a box."""

    def __init__(self, settings: Settings) -> None:
        self._lower, self._upper = settings.lower, settings.upper
        self._possible = settings.bounded and settings.n > 1

    def may_begin(self, lines: AxisLines | None, *, several: bool) -> bool:
        """Whether there may be something lower; `several`: quadratics have arrived at several minima."""
        return self._possible and (lines is None or lines.stage in _FURTHER or (several and lines.stage == "convex"))

    def begin(self, lines: AxisLines | None, best: Best, points: Tensor, losses: Tensor) -> tuple[AxisLines, Tensor]:
        """Return lines and the first points [K, n], given the best point and evaluations [P, n] with losses [P]."""
        x = best.point
        if lines is not None and lines.stage in _FURTHER:  # the best point is not on the lines: place it there
            until = lines.places.shape[1] + _PLACES
            return replace(lines, stage="axes", before=x, until=until), lines.on_axes(x[None])
        if lines is not None:
            return self._along(_crossing(lines, best))
        k = int((points - x).abs().amin(1).argmax())
        other, nothing = points[k], x.new_zeros(len(x), 0)
        half = torch.arange(len(x), device=x.device) % 2 == 0  # neighbours are the likeliest to act together
        exchanged = torch.stack([torch.where(half, other, x), torch.where(half, x, other)])
        lines = AxisLines(
            origin=best, other=other, other_loss=float(losses[k]), before=x, places=nothing, changes=nothing
        )
        return lines, exchanged

    def next(self, lines: AxisLines, evaluated: Evaluated, *, several: bool) -> tuple[AxisLines, Tensor]:
        """Return the lines after an evaluation, and the next points [K, n]; none where the search has ended."""
        nothing = evaluated.points[:0]
        if lines.stage == "axes":
            return self._along(lines.adding(evaluated))
        if lines.stage == "exchanged":
            if len(evaluated) < 2 or not _is_sum(lines, evaluated.usable):
                return replace(lines, stage="over"), nothing
            if not several:
                return replace(lines, stage="chord"), self._chord(lines)
        elif _is_convex(lines, evaluated):
            return replace(lines, stage="convex"), nothing
        return self._along(_crossing(lines, lines.origin))

    def more(self, lines: AxisLines, count: int) -> Tensor:
        """Return up to `count` further points [K, n] that are worth evaluating at once."""
        n, known = lines.places.shape
        further = lines.places[:, :0].mT if known < 3 else lines.middles(1 + count // n)[1:]
        return lines.on_axes(further)

    def _chord(self, lines: AxisLines) -> Tensor:
        """Return points [K, n] on the line through origin and other point, from one side of the box to the other."""
        x, step = lines.origin.point, lines.other - lines.origin.point
        ends = torch.stack([self._lower - x, self._upper - x]) / step
        first, last = float(ends.amin(0).max()), float(ends.amax(0).min())
        t = torch.linspace(first, last, _CHORD, dtype=x.dtype, device=x.device)
        return (x + t[:, None] * step).clamp(self._lower, self._upper)

    def _along(self, lines: AxisLines) -> tuple[AxisLines, Tensor]:
        """Ask for a point on every axis, or end where enough are known."""
        known = lines.places.shape[1]
        if known >= lines.until:
            lower = not torch.equal(lines.lowest, lines.before)
            return replace(lines, stage="lower" if lower else "level"), lines.before[None][:0]
        places = lines.middles(1) if known > 2 else (self._lower, self._upper)[known - 1][None]
        return lines, lines.on_axes(places)


def _crossing(lines: AxisLines, at: Best) -> AxisLines:
    """Return the lines through a point, on which no other place is known."""
    places = at.point[:, None]
    return replace(
        lines, stage="axes", origin=at, before=at.point, places=places, changes=torch.zeros_like(places), until=_PLACES
    )


def _is_sum(lines: AxisLines, losses: Tensor) -> bool:
    """Whether the losses [2] at points with exchanged coordinates are those of a sum."""
    ends = losses.new_tensor([lines.origin.loss, lines.other_loss])
    change, difference = float((losses[:, None] - ends).abs().min()), float((losses.sum() - ends.sum()).abs())
    apart = bool((lines.other != lines.origin.point).all())
    return apart and change > 0.0 and difference <= _SUM * change  # False for values that are not finite


def _is_convex(lines: AxisLines, evaluated: Evaluated) -> bool:
    """Whether the losses on the chord are convex."""
    evaluated = evaluated.sound
    step = lines.other - lines.origin.point
    t = torch.cat([((evaluated.points - lines.origin.point) @ step) / (step @ step), step.new_tensor([0.0, 1.0])])
    losses = torch.cat([evaluated.losses, step.new_tensor([lines.origin.loss, lines.other_loss])])
    t, order = t.sort()
    losses = losses[order]
    part = (t[1:-1] - t[:-2]) / (t[2:] - t[:-2]).clamp(min=torch.finfo(t.dtype).tiny)
    between = losses[:-2] + part * (losses[2:] - losses[:-2])
    return bool((losses[1:-1] - between <= _AS_LOW * (losses.max() - losses.min())).all())
