"""Where a search stands: what its state says of the best point, of its progress, and of its end."""

from abc import ABC
from collections.abc import Callable
from typing import Generic

import torch
from torch import Tensor

from torch_zerohess.estimation.inputs import named
from torch_zerohess.search.protocol.method import Method
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.space import Space
from torch_zerohess.search.protocol.state import P, State
from torch_zerohess.surrogates.quadratic import LocalModel


class Standing(ABC, Generic[P]):
    """What can be read from a search; nothing of it changes the search."""

    _space: Space
    _method: Method[P]
    _state: State[P]

    @property
    def engine(self) -> str:
        """Which search it is: "gaussian_process", "descent", ..."""
        return self._method.engine

    @property
    def reason(self) -> str:
        """Why this engine, in a sentence."""
        return "the caller chose it"

    @property
    def loss(self) -> Callable[[Tensor], Tensor] | None:
        """The white box from an output to a number; None where the black box returns the loss."""
        return self._method.settings.loss

    @property
    def x(self) -> Tensor:
        """The best point so far [n]."""
        return self._space.parameters(self._state.progress.best.point)

    @property
    def value(self) -> float:
        """The loss there; infinite before the first `tell`."""
        return self._state.progress.best.loss

    @property
    def center(self) -> Tensor:
        """Where the search is now [n], not always its best point."""
        return self._space.parameters(self._state.progress.center)

    @property
    def averages(self) -> bool:
        """Whether a model of many evaluations has chosen `x`, and not a single value."""
        return self._method.has_averaged(self._state.progress)

    @property
    def sigma(self) -> float:
        """Current smoothing, in units of the first one."""
        return self._state.progress.sigma

    @property
    def unit(self) -> Tensor:
        """The first sigma of every parameter [n]: the unit of `sigma` and of `LocalModel`."""
        return self._space.unit.clone()

    @property
    def bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds [n], infinite where there are none."""
        return self._space.lower, self._space.upper

    @property
    def evaluations(self) -> int:
        """Values told so far."""
        return self._state.progress.evaluations

    @property
    def iterations(self) -> int:
        """Steps tried so far."""
        return self._state.progress.iterations

    @property
    def rounds(self) -> int:
        """Times the search has arrived."""
        return self._state.progress.rounds

    @property
    def solved(self) -> bool:
        """Whether the best point is one at which the search has arrived: a minimum, possibly a local one."""
        return self._state.progress.is_at_arrival(self._method.settings.tolerance)

    @property
    def tolerance(self) -> float:
        """Length, in units of the first sigma sqrt(n), below which it arrives."""
        return self._method.settings.tolerance

    @property
    def polished(self) -> bool:
        """Whether the minimum of `solved` is exact up to rounding, as far as a model tells.

        Otherwise the search has arrived because its steps became short.
        """
        return self._state.progress.arrivals.polished

    @property
    def agreed(self) -> int:
        """Rounds in a row that have arrived at the best point, or at other points with the same loss."""
        return self._state.progress.agreed

    @property
    def higher(self) -> int:
        """Rounds since the first of these that began at random points and arrived at higher minima."""
        return self._state.progress.arrivals.higher

    @property
    def apart(self) -> bool:
        """Whether these rounds have arrived at several points."""
        return self._state.progress.arrivals.apart

    @property
    def promise(self) -> float:
        """By how much the next step lowers the loss, according to a model that holds there; infinite without one."""
        return self._method.promise(self._state.progress)

    @property
    def width(self) -> Tensor:
        """Half of the extent of the current region along every parameter [n], in units of the parameters."""
        return self._method.width(self._state.progress) * self._space.unit

    @property
    def untouched(self) -> Tensor | None:
        """Parameters that no output was found to depend on, and that stay: bools [n]; None if nothing is known."""
        return self._method.untouched(self._state.progress)

    @property
    def done(self) -> bool:
        """Whether there is nothing more to ask."""
        return self._state.progress.done

    @property
    def message(self) -> str:
        """Why the search is done."""
        return self._state.progress.message

    def __repr__(self) -> str:
        end = f"done: {self.message}" if self.done else f"sigma / its start = {self.sigma:.4g}"
        told = f"value={self.value:.6g}, {named('x', self.x)}" if self.evaluations else named("start", self.x)
        name = type(self).__name__
        return f"{name}(engine={self.engine!r}, n={len(self.unit)}, evaluations={self.evaluations}, {told}, {end})"

    def model_at_best(self, x: Tensor | None = None) -> tuple[LocalModel, float] | None:
        """Return a quadratic model around the best point, or around `x` [n] if given, and its sigma.

        That is the sigma at which the point was found; it is wider if few evaluations lie near. None before the first
        `tell`, or if no evaluations near the point are kept.
        """
        progress = self._state.progress
        if x is not None and not torch.equal(x, self.x):
            progress = replace(progress, best=replace(progress.best, point=self._space.coordinates(x)))
        return self._method.model_at_best(progress)
