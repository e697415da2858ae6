"""The progress of a search by quadratics in a trust region, between two evaluations."""

import math
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, TypeVar

import torch
from torch import Tensor

from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import LOST, Best, Evaluated, Progress
from torch_zerohess.search.region.cut_steps import CutSteps
from torch_zerohess.surrogates.pool import latest

_AT_BORDER = 10 * LOST
"""Batches in a row that are lost beside a border, after which a round ends. Half of the steps there may fail."""

R = TypeVar("R", bound="RegionProgress")


@dataclass(frozen=True, eq=False, kw_only=True)
class RegionProgress(Progress):
    """A round: its evaluations, the last quadratic, and the region best + sigma B u, |u| <= 1."""

    points: Tensor
    """Evaluations of the round [P, n]."""
    values: Tensor
    """[P]"""
    holes: Tensor
    """Which of the evaluations [P] have no finite value. Their entry of `values` is the highest one of the round."""
    border: Tensor | None = None
    """Rows of a and b [m, n + 1] of planes a.s = b, s from the best point. Each hole near it has a.s > b for one."""
    cuts: CutSteps = field(default_factory=CutSteps)
    """Steps that the border has cut short."""
    root: Tensor
    """B [n, n], symmetric, positive, of determinant 1."""
    hessian: Tensor
    """Of the last quadratic [n, n], in units of `size`."""
    gradient: Tensor
    """Of the last quadratic at the best point of the round [n], in units of `size`."""
    size: float = 1.0
    """Largest difference of the values that the last quadratic was fitted to."""
    lowest: Best
    """The best point of the round."""
    phase: Literal["start", "axes", "trial", "geometry", "slope", "aside", "lines"] = "start"
    """What is asked for: the start and n points, n further ones, the end of a step, a point that improves the model, a
    slope at a kink, two points beside a flat end, or points along the axes."""
    promised: float = 0.0
    """Decrease that the model promises at the end of the step."""
    length: float = 0.0
    """Of the step, in units of the region."""
    expected: float = math.inf
    """Loss that the model predicts at the last point that was to improve it."""
    confirmed: bool = False
    """Whether the loss there was as predicted."""
    good: bool = False
    """Whether the last step of this search was not rejected."""
    rejected: int = 0
    """Steps in a row that were rejected."""
    tied: int = 0
    """Steps in a row whose end has exactly the value of the best point."""

    @property
    def is_lost(self) -> bool:
        """Whether so many batches in a row were lost that the round ends."""
        return self.lost >= (LOST if self.border is None else _AT_BORDER)

    @cached_property
    def scaled(self) -> Tensor:
        """The evaluations as u [P, n]."""
        return torch.linalg.solve(self.root, (self.points - self.lowest.point).mT).mT / self.sigma

    def cut_or_free(self: R, cut: Tensor, free: Tensor) -> R:
        """Return the progress without the border if the next step is to ignore it.

        Args:
            cut: the step with the border [n].
            free: the step without it [n].
        """
        u = torch.linalg.solve(self.root, torch.stack([cut, free], 1)).mT / self.sigma
        cuts = self.cuts.planned(self.scaled, self.holes, u[0], u[1])
        return replace(self, cuts=cuts, border=None if cuts.last == "free" else self.border)

    def holding(self: R, points: Tensor, values: Tensor, **own: Any) -> R:
        """Return a round with other evaluations [P, n] and finite values [P]."""
        return replace(self, points=points, values=values, holes=torch.zeros_like(values, dtype=torch.bool), **own)

    def avoiding(self: R, points: Tensor) -> R:
        """Add points [K, n] without a finite value to a round with evaluations."""
        values = torch.cat([self.values, self.values.max().expand(len(points))])
        holes = torch.cat([self.holes, self.holes.new_ones(len(points))])
        return replace(self, points=torch.cat([self.points, points]), values=values, holes=holes)

    def remembered(self: R, evaluated: Evaluated, capacity: int) -> R:
        """Add evaluations; a value that is not finite counts as the highest one of the round."""
        finite = evaluated.finite
        new = evaluated.those(finite)
        lowest = self.lowest.or_lower(new, self.sigma)
        points, values = torch.cat([self.points, new.points]), torch.cat([self.values, new.losses])
        holes = torch.cat([self.holes, torch.zeros_like(new.losses, dtype=torch.bool)])
        known = replace(
            self.told(evaluated, lost=evaluated.lacking),
            best=self.best.or_lower(new, self.sigma),
            lowest=lowest,
            center=lowest.point,
            points=points,
            values=values,
            holes=holes,
        )
        if len(values):
            known = known.avoiding(evaluated.points[~finite])
        which = latest(known.points, lowest.point, capacity)
        return replace(known, points=known.points[which], values=known.values[which], holes=known.holes[which])
