"""A search behind ask and tell: settings that never change, and a pure step.

The step takes the progress so far (`Progress`) and the latest values (`Evaluated`), and returns the next progress and
the points to evaluate next.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar, Generic

import torch
from torch import Tensor

from torch_zerohess.search.protocol.random_points import normal, reflect, uniform
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated, P
from torch_zerohess.search.protocol.told_values import moderate
from torch_zerohess.surrogates.quadratic import LocalModel

_AWAY = 2.0
"""Standard deviation of a further start from the first one, where there is no box to draw it from."""
_WIDEST_BOX = 1e100
"""Distance between two bounds, in units of the first sigma, from which they count as none: models of the whole box take
squares of distances in it, which must not overflow."""


@dataclass(frozen=True, eq=False)
class Settings:
    """What a search is given, in units of its first sigma. See `AskTell` for the meaning."""

    start: Tensor
    """[n], float64."""
    lower: Tensor
    """[n], float64; minus infinity where there is no bound."""
    upper: Tensor
    """[n], float64; infinity where there is no bound."""
    loss: Callable[[Tensor], Tensor] | None
    restarts: int
    tolerance: float
    noise: float
    pool: int | None

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.start)

    @property
    def white_box(self) -> Callable[[Tensor], Tensor]:
        """The loss, for a search that has one."""
        assert self.loss is not None
        return self.loss

    @property
    def bounded(self) -> bool:
        """Whether the bounds are those of a box that a search can look all over: finite, and not too far apart."""
        return bool((self.upper - self.lower < _WIDEST_BOX).all())

    def inside(self, points: Tensor) -> Tensor:
        """Mirror points [K, n] into the bounds."""
        return reflect(points, self.lower, self.upper)

    def drawn(self, x: Tensor, sigma: float, count: int, generator: torch.Generator) -> Tensor:
        """Draw points [count, n] from N(x, sigma^2), mirrored into the bounds."""
        return self.inside(x + sigma * normal(generator, x, count, self.n))

    def further_start(self, generator: torch.Generator) -> Tensor:
        """Draw the point [n] where another round begins: anywhere in a finite box, otherwise around the start."""
        if self.bounded:
            return uniform(generator, self.lower, self.upper, 1)[0]
        return (self.start + _AWAY * normal(generator, self.start, self.n)).clamp(self.lower, self.upper)


class Method(ABC, Generic[P]):
    """A search as settings and a pure step.

    A method changes no `Progress` that it was given, and of itself at most a cache. All randomness is drawn from the
    generator. Both `first` and `next` return points [K, n] within the bounds, at least one unless the search is done.
    """

    engine: ClassVar[str]
    """Name for a reader."""
    averages: ClassVar[bool] = False
    """Whether a model of many evaluations chooses the best point, not a single value: always, or at the end."""
    progress: type[P]
    """Class of what it knows."""

    def __init__(self, settings: Settings) -> None:
        self.settings = settings

    @abstractmethod
    def first(self, generator: torch.Generator) -> tuple[P, Tensor]:
        """Return the progress at the beginning, and the first points [K, n], of which the first is the start."""

    @abstractmethod
    def next(self, known: P, evaluated: Evaluated, generator: torch.Generator) -> tuple[P, Tensor]:
        """Return the progress after an evaluation, and the next points [K, n]."""

    def after(self, known: P, told: Evaluated, generator: torch.Generator) -> tuple[P, Tensor]:
        """Return `next` for what a caller told. Losses whose models fail numerically count as not finite."""
        random, told = generator.get_state(), moderate(told)
        try:
            return self.next(known, told, generator)
        except torch.linalg.LinAlgError:  # type: ignore[attr-defined]
            if self.settings.loss is not None or not known.evaluations:  # the loss of the caller may have raised it
                raise
            generator.set_state(random)
            return self.next(known, replace(told, losses=torch.full_like(told.losses, math.inf)), generator)

    def more(self, known: P, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return up to `count` points that are worth evaluating at once with those [K, n] that the search asks for.

        By default there are none. `next` gets their values after the others, see `Evaluated`.
        """
        return points[:0]

    @abstractmethod
    def model_at_best(self, known: P) -> tuple[LocalModel, float] | None:
        """Return a quadratic model around the best point and its sigma, or None if too little is known there."""

    def has_averaged(self, known: P) -> bool:
        """Return whether a model of many evaluations has chosen the best point."""
        return self.averages

    def promise(self, known: P) -> float:
        """Return by how much the next step lowers the loss, according to a model that holds there; or infinity."""
        return math.inf

    def width(self, known: P) -> Tensor:
        """Return half of the extent of the region along every parameter [n]."""
        return torch.full_like(known.best.point, known.sigma)

    def untouched(self, known: P) -> Tensor | None:
        """Return the parameters that no output was found to depend on, and that stay: bools [n]; None if unknown."""
        return None
