"""The progress of a search by a Gaussian process between two evaluations."""

import math
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
from torch import Tensor

from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Progress
from torch_zerohess.surrogates.pool import Pool

_LOOKING = 10
"""Evaluations over n + 1 that a round has at least to look for something better before it counts as one that agrees."""

Q = TypeVar("Q", bound="ProcessProgress")


@dataclass(frozen=True, eq=False, kw_only=True)
class ProcessProgress(Progress):
    """A pool of evaluations, and how far the last step went.

    In noise `best` is the point whose predicted loss is lowest; otherwise it is `record`.
    """

    pool: Pool
    room: int = 0
    """Evaluations that the pool keeps at least, since there were batches."""
    phase: Literal["start", "trial"] = "start"
    """What is asked for: the start and points around it, or the end of a step."""
    record: Best
    """The lowest loss that was evaluated."""
    expands: bool
    """Whether the loss of a predicted output is expanded; otherwise the process is one of the loss itself."""
    expanded: Tensor | None = None
    """Point [n] at whose predicted output the loss was last expanded; None if at the best evaluated output."""
    noisy: bool = False
    """Whether outputs differ from call to call."""
    moved: float = math.inf
    """Distance of the last step from the best point, in units of the first sigma sqrt(n); infinite if it explores."""
    settled: int = 0
    """Steps in a row that stayed at the best point."""
    exploring: int = 0
    """Steps that are still to be more optimistic than others."""
    holes: Tensor
    """Points [H, n] whose values were not finite."""
    solved: Tensor | None = None
    """A minimum that is known to the last digit [n]; None if none is."""
    counted: int = 0
    """Evaluations at the latest arrival that has counted as a round of those that agree."""

    def arriving_here(self: Q, tolerance: float, end: Best | None = None) -> Q:
        """Count an arrival at the best point, or at `end`.

        It agrees with earlier arrivals if the search has since evaluated elsewhere as often as it had evaluated until
        then: beside a minimum that was hard to find there may be a lower one that is as hard to find.
        """
        found = self.is_minimum(tolerance)
        if found or (self.noisy and not self.is_on_plateau(tolerance)):
            self = self.arriving(self.best, polished=self.noisy or self.is_solved)
        if not found:  # a plateau, or no minimum of the quadratics
            return self
        known = self.agreeing(end or self.best, tolerance, self.pool.values)
        if known.agreed > 1 and not self.has_looked:
            return self
        return replace(known, counted=self.evaluations)

    @property
    def has_looked(self) -> bool:
        """Whether a further arrival would count as a round that agrees."""
        return self.evaluations - self.counted >= max(self.counted, _LOOKING * (len(self.center) + 1))

    @property
    def is_solved(self) -> bool:
        """Whether the best point is a minimum that is known to the last digit."""
        return self.solved is not None and torch.equal(self.solved, self.best.point)

    def is_minimum(self, tolerance: float) -> bool:
        """Whether neither noise nor a plateau has chosen the best point."""
        return not self.noisy and not self.is_on_plateau(tolerance)

    def is_on_plateau(self, tolerance: float) -> bool:
        """Whether evaluations around the best point have exactly its value."""
        return self.pool.ties(self.best.point, self.best.loss, tolerance)
