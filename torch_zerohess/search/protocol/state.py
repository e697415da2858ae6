"""The state of a search as frozen dataclasses, and the plain dictionaries that `state_dict` makes of them."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Generic, TypeVar, get_args, get_type_hints

import torch
from torch import Tensor

from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.version import written_by

T = TypeVar("T")
_SCALAR = torch.Size()

EQUAL = 1e-4
"""Difference between two losses that are the same, over the distance of the lower quartile of all from the lowest."""
LOST = 10
"""Batches in a row that are lost, after which a round or the search ends."""


@dataclass(frozen=True, eq=False)
class Best:
    """The best point [n], its loss, and the sigma at which it was found."""

    point: Tensor
    loss: float = math.inf
    sigma: float = 1.0

    def or_lower(self, new: "Evaluated", sigma: float) -> "Best":
        """Return this point, or the lowest of new points with finite values where that is lower."""
        if not len(new):
            return self
        k = int(new.losses.argmin())
        loss = float(new.losses[k])
        return Best(new.points[k].clone(), loss, sigma) if loss < self.loss else self


@dataclass(frozen=True, eq=False, kw_only=True)
class Arrivals:
    """The rounds of a search that have ended, and where it has arrived."""

    rounds: int = 0
    """Rounds that have ended, most of them where the search has arrived."""
    lowest: Best | None = None
    """The lowest point at which it has arrived."""
    polished: bool = True
    """Whether it is a minimum up to rounding, as far as a model tells. Otherwise only the steps became short there."""
    agreed: int = 0
    """Rounds that have arrived at the best point, or at other points with the same loss, and none at a lower one."""
    higher: int = 0
    """Rounds since the first of them that began at random points and arrived at higher minima."""
    place: Best | None = None
    """The best point when the first of them arrived."""
    apart: bool = False
    """Whether some of them arrived at another point: there are several minima, or the floor of a valley."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Progress:
    """What a search knows after the values that it was told. A search adds its own fields in a subclass.

    Points are coordinates [n], float64, in units of the first sigma (`Space`).
    """

    best: Best
    center: Tensor
    """Where the search is now [n]."""
    sigma: float = 1.0
    evaluations: int = 0
    iterations: int = 0
    """Steps tried."""
    arrivals: Arrivals = Arrivals()
    lost: int = 0
    """Batches in a row that were lost. A batch is lost if a point that the search needed has no finite value; in noise,
    and for Gauss-Newton, if no point has one."""
    done: bool = False
    message: str = ""
    """Why the search is done."""
    shape: torch.Size = _SCALAR
    """Of an output, [*out]; empty before the first one and where the black box returns the loss."""

    @property
    def rounds(self) -> int:
        """Rounds that have ended."""
        return self.arrivals.rounds

    @property
    def agreed(self) -> int:
        """Rounds in a row that agree."""
        return self.arrivals.agreed

    def taking(self: "P", other: "Progress", *names: str) -> "P":
        """Return this progress with fields of another one: those of the names, or all that every search has."""
        return replace(self, **{name: getattr(other, name) for name in names or _COMMON})

    def told(self: "P", evaluated: "Evaluated", *, lost: bool) -> "P":
        """Count a batch, which is lost or not, and note the shape of its outputs."""
        evaluations, lost_in_a_row = self.evaluations + len(evaluated), self.lost + 1 if lost else 0
        return replace(self, evaluations=evaluations, lost=lost_in_a_row, shape=evaluated.shape)

    def is_at_arrival(self, tolerance: float) -> bool:
        """Whether the best point is one at which the search has arrived; tolerance: see `are_same`."""
        end = self.arrivals.lowest
        if end is None or self.rounds == 0 or self.best.loss > end.loss:
            return False
        return are_same(self.best.point, end.point, tolerance)

    def ended_round(self: "P", reason: str, restarts: int) -> "P":
        """Count a round that ends. The search is done after `restarts` further rounds."""
        known = self.with_arrivals(rounds=self.rounds + 1)
        if known.rounds <= restarts:
            return known
        return replace(known, done=True, message=f"{reason}, in round {known.rounds}")

    def arriving(self: "P", end: Best, *, polished: bool = True) -> "P":
        """Note that the search has arrived; polished: see `Arrivals`."""
        lowest = self.arrivals.lowest
        before = math.inf if lowest is None else lowest.loss
        if end.loss < before:
            return self.with_arrivals(lowest=end, polished=polished)
        return self.with_arrivals(polished=True) if polished and end.loss == before else self

    def agreeing(self: "P", end: Best, tolerance: float, losses: Tensor | None = None) -> "P":
        """Count a round that has arrived.

        It agrees with earlier rounds in either case:
        (a) it ends at the best point, and they did too;
        (b) its loss and theirs equal the best loss, up to `losses`.

        Args:
            end: the lowest point of the round.
            tolerance: see `are_same`.
            losses: evaluations [P], against whose lower quartile two losses are the same: penalties are above it. None
                if losses are not to be compared.
        """
        best, place, apart = self.best, self.arrivals.place, self.arrivals.apart
        slack = -math.inf if losses is None else EQUAL * (float(losses.quantile(0.25)) - best.loss)

        def is_best(one: Best) -> bool:
            return are_same(one.point, best.point, tolerance) or one.loss - best.loss <= slack

        if not is_best(end):
            return self.with_arrivals(agreed=0)
        if place is None or self.agreed == 0 or not is_best(place):
            return self.with_arrivals(
                agreed=1, higher=0, place=best, apart=not are_same(end.point, best.point, tolerance)
            )
        apart = apart or not are_same(end.point, place.point, tolerance)
        return self.with_arrivals(agreed=self.agreed + 1, apart=apart)

    def with_arrivals(self: "P", **changes: Any) -> "P":
        """Return the progress with changes of its arrivals."""
        return replace(self, arrivals=replace(self.arrivals, **changes))


_COMMON = tuple(field.name for field in fields(Progress))

P = TypeVar("P", bound=Progress)


def not_finite(batches: int) -> str:
    """Why a round or the search ends after so many batches that are lost."""
    return f"{batches} batches in a row had values that are not finite"


def are_same(one: Tensor, other: Tensor, tolerance: float) -> bool:
    """Whether points [n] are within the tolerance, root mean square over the parameters."""
    return float((one - other).norm()) < tolerance * math.sqrt(len(one))


@dataclass(frozen=True, eq=False)
class State(Generic[P]):
    """Everything that changes while a search goes on. `tell` replaces it as a whole."""

    progress: P
    asked: Tensor
    """Points [K, n] that are to be evaluated; none when the search is done."""
    random: Tensor
    """State of the random generator, after `asked` was drawn."""


@dataclass(frozen=True, eq=False)
class Evaluated:
    """Points [K, n] that the search asked for, and what the caller told about them."""

    points: Tensor
    losses: Tensor
    """[K]"""
    outputs: Tensor | None = None
    """[K, m], outputs [K, *out] in a row; None where the black box returns the loss."""
    shape: torch.Size = _SCALAR
    """Of an output, [*out]."""
    extra: int = 0
    """How many of them, the last ones, are from `Method.more`."""

    def __len__(self) -> int:
        return len(self.losses)

    @property
    def finite(self) -> Tensor:
        """Which of the points have finite values [K]."""
        finite = torch.isfinite(self.losses)
        return finite if self.outputs is None else finite & torch.isfinite(self.outputs).all(1)

    @property
    def sound(self) -> "Evaluated":
        """The points with finite values."""
        return self.those(self.finite)

    @property
    def lacking(self) -> bool:
        """Whether a point that the method itself asked for has no finite value."""
        return not bool(self.needed.finite.all())

    @property
    def usable(self) -> Tensor:
        """The losses [K]; NaN where a loss ignores numbers of the output that are not finite: no model can."""
        return torch.where(self.finite | ~torch.isfinite(self.losses), self.losses, math.nan)

    @property
    def needed(self) -> "Evaluated":
        """The points that the method itself asked for."""
        return self.those(slice(len(self) - self.extra)) if self.extra else self

    @property
    def further(self) -> "Evaluated":
        """The points from `Method.more`."""
        return self.those(slice(len(self) - self.extra, None))

    def those(self, which: Tensor | slice) -> "Evaluated":
        """The points that `which` selects: bools [K], indices, or a slice."""
        outputs = None if self.outputs is None else self.outputs[which]
        numbers = torch.arange(len(self), device=self.points.device) if self.extra else None
        extra = 0 if numbers is None else int((numbers[which] >= len(self) - self.extra).sum())
        return Evaluated(self.points[which], self.losses[which], outputs, self.shape, extra)


def plain(value: Any) -> Any:
    """Return a dataclass as a dictionary of tensors, numbers, strings, lists and such dictionaries.

    Fields that are made of the others are left out.
    """
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value) if field.init}
    return [plain(one) for one in value] if isinstance(value, tuple) else value


def restored(kind: type[T], data: dict[str, Any], device: torch.device) -> T:
    """Return the dataclass of which `plain` made `data`, with its tensors on the device.

    ValueError if it has other fields.
    """
    hints = get_type_hints(kind)
    names = [field.name for field in dataclasses.fields(kind) if field.init]  # type: ignore[arg-type]
    for wrong, verb in ((set(names) - data.keys(), "lacks"), (data.keys() - set(names), "has")):
        if wrong:
            raise ValueError(f"its {kind.__name__} {verb} {', '.join(sorted(wrong))}")
    return kind(**{name: _restored(hints[name], data[name], device) for name in names})


def restored_progress(kind: type[P], state: Mapping[str, Any], device: torch.device) -> P:
    """Return the progress in a `state_dict`. ValueError if it has other fields: another version wrote it."""
    try:
        return restored(kind, state["progress"], device)
    except ValueError as error:
        raise ValueError(
            f"state must be one that this version can read: {error} ({written_by(state)}): begin a new search with its "
            "evaluations, by tell_at, or known= of minimize"
        ) from error


def _restored(hint: Any, value: Any, device: torch.device) -> Any:
    if isinstance(value, dict):
        (kind,) = (one for one in (hint, *get_args(hint)) if dataclasses.is_dataclass(one))
        return restored(kind, value, device)  # type: ignore[arg-type]
    if isinstance(value, list):
        return torch.Size(value) if hint is torch.Size else tuple(value)
    return value.to(device) if isinstance(value, Tensor) else value
