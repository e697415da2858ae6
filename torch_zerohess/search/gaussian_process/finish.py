"""A Gaussian process that a local search finishes: whose turn it is, and what one passes to the other.

The process crosses plateaus and leaves local minima (`ProcessMethod`). It leaves a millionth of a smooth function
unexplained, where models of the nearest evaluations leave next to nothing. A subclass says which local search it is
(`RegionDescent`), when its turn comes, and what follows where it ends.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Any, TypeVar

import torch
from torch import Tensor

from torch_zerohess.search.gaussian_process.method import APART, ProcessMethod
from torch_zerohess.search.gaussian_process.progress import ProcessProgress
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated
from torch_zerohess.search.region.method import RegionDescent
from torch_zerohess.search.region.progress import RegionProgress
from torch_zerohess.surrogates.plateau import is_plateau

PATIENCE = 3
"""Evaluations over n + 1 in which the process must find something better."""


@dataclass(frozen=True, eq=False, kw_only=True)
class FinishedProgress(ProcessProgress):
    """What the process knows, and what the local search knows."""

    local: RegionProgress | None = None
    """Of the local search, also when it has ended."""
    finishing: bool = False
    """Whether it is the turn of the local search."""
    finished: Tensor | None = None
    """Where the local search has ended [n]; None before."""
    waited: int = 0
    """Evaluations since something better was found, or since the turn has changed."""

    @property
    def handed_over(self) -> bool:
        """Whether it is the turn of another search than the process."""
        return self.finishing

    def is_on_plateau(self, tolerance: float) -> bool:
        """Judge by the evaluations of the local search where it has found the best point: it has nearer ones."""
        local, best = self.local, self.best
        if local is None or not torch.equal(local.best.point, best.point):
            return super().is_on_plateau(tolerance)
        return is_plateau(local.points - best.point, local.values, best.loss, beyond=tolerance)


F = TypeVar("F", bound=FinishedProgress)


class FinishedProcess(ProcessMethod[F]):
    """A process and a local search in turn."""

    local: RegionDescent[Any]

    @abstractmethod
    def after_process(self, known: F, evaluated: Evaluated, generator: torch.Generator) -> tuple[F, Tensor]:
        """Let the process learn, and return the first points of the local search if its turn has come."""

    @abstractmethod
    def after_local(self, known: F, evaluated: Evaluated, generator: torch.Generator) -> tuple[F, Tensor]:
        """Let the local search learn, and return its next points if it is still its turn."""

    def first(self, generator: torch.Generator) -> tuple[F, Tensor]:
        return self.points(self.begun(), generator)

    def next(self, known: F, evaluated: Evaluated, generator: torch.Generator) -> tuple[F, Tensor]:
        after = self.after_local if known.finishing else self.after_process
        known, points = after(known, evaluated, generator)
        return (known, points) if known.handed_over else self.points(known, generator)

    def more(self, known: F, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        if known.finishing:
            return self.local.more(known.local, points, count, generator)
        return super().more(known, points, count, generator)

    def promise(self, known: F) -> float:
        local = self._at_best(known)
        return math.inf if local is None else self.local.promise(local)

    def width(self, known: F) -> Tensor:
        """Return the region of the local search if it is at the best point; or infinity."""
        local = self._at_best(known)
        return torch.full_like(known.center, math.inf) if local is None else self.local.width(local)

    def _at_best(self, known: F) -> RegionProgress | None:
        """Return the progress of the local search if it is at the best point, and its turn has come."""
        local = known.local
        if local is None or not known.finishing or not torch.equal(local.best.point, known.best.point):
            return None
        return local

    def is_new(self, known: F) -> bool:
        """Whether the best point is apart from the point where the local search has ended last."""
        return known.finished is None or float((known.best.point - known.finished).norm()) > APART

    def learned(self, known: F, evaluated: Evaluated) -> F:
        """Let the process learn evaluations of another search that are apart from its own."""
        known = self.avoiding(known, evaluated.points[~evaluated.finite])
        for k in evaluated.finite.nonzero().flatten().tolist():
            if float((known.pool.points - evaluated.points[k]).norm(dim=1).min()) > APART:
                known = self.remembered(known, evaluated.those(slice(k, k + 1)))
        return known

    def told(self, known: F, now: RegionProgress, evaluated: Evaluated) -> F:
        """Return the progress after the local search has come to `now`. The process gets what is new to it."""
        before = known.local
        assert before is not None
        known = self.learned(known, evaluated)
        best = now.best if now.best.loss <= known.best.loss else known.best
        return replace(
            known,
            best=best,
            record=best if best is now.best else known.record,
            center=now.center,
            sigma=now.sigma,
            local=now,
            evaluations=known.evaluations + len(evaluated),
            iterations=known.iterations + now.iterations - before.iterations,
            waited=0 if now.best.loss < before.best.loss else known.waited + len(evaluated.needed),
        )
