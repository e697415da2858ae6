"""Every evaluation of a search in order, and the values that an interrupted request has left."""

import contextlib
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.inputs import short
from torch_zerohess.evaluators.returned import ReturnedValueError
from torch_zerohess.evaluators.single_nan import alike
from torch_zerohess.minimization.known import Known
from torch_zerohess.minimization.minimality_checks import DEEP, is_unbounded

_HELD = 1 << 22
"""Numbers of outputs that are kept, at most; the last request is kept whole."""

Call = Callable[[Tensor], tuple[list[int], Tensor, BaseException | None]]
"""Evaluate points [K, n]: the numbers of those that have a value, these values [k, *out], and what was raised."""


class Record:
    """Evaluations in batches, each of one request.

    Args:
        call: evaluates points.
        losses: of values [K, *out], [K].
        x0: [n], whose type and device points have.
    """

    def __init__(self, call: Call, losses: Callable[[Tensor], Tensor], x0: Tensor) -> None:
        self._call, self._losses = call, losses
        self.requested: Tensor | None = None
        """Points [K, n] that are being evaluated; None between two requests."""
        self._numbers, self._values = list[int](), x0.new_empty(0)
        self._batches = [(x0[None][:0], x0.new_empty(0, dtype=torch.float64))]
        self._open: tuple[Tensor, Tensor] | None = None
        self.last = self._batches[0]
        """Points [K, n] and losses [K] of the last complete request."""
        self.complete = 0
        """Evaluations of complete requests."""
        self.keeps_outputs = True
        """Whether the outputs of further requests are kept."""
        self._outputs = [x0.new_empty(0, 0)]
        """Of the last complete evaluations [k, *out], in batches."""
        self._first: Tensor | None = None
        """The first output [*out]."""
        self._same = True
        """Whether all outputs are known to be equal to it."""
        self.early: list[Tensor] | None = []
        """The first outputs [*out], as long as they are few numbers; None when they were looked at."""
        self.given: list[int] = []
        """Numbers of the evaluations that the caller had before, all of them in the first request."""
        self.opening = 0
        """Points of the first request, while it is open, if the caller had some of them; otherwise 0."""

    @property
    def known(self) -> int:
        """How far the request has got: the number after the last point that was evaluated."""
        had = set() if self.complete else set(self.given)
        return max((number for number in self._numbers if number not in had), default=-1) + 1

    @property
    def due(self) -> int:
        """Points of the request that have no value yet."""
        return 0 if self.requested is None else len(self.requested) - len(self._numbers)

    @property
    def told(self) -> tuple[Tensor, Tensor]:
        """All points [evaluations, n] and their losses [evaluations]; an interrupted request comes last."""
        if len(self._batches) > 1:
            self._batches = [_joined(self._batches)]
        return _joined([*self._batches, self._interrupted]) if self._numbers else self._batches[0]

    @property
    def evaluations(self) -> int:
        """Number of evaluations, including the evaluations of an interrupted request."""
        return self.complete + (len(self._interrupted[1]) if self._numbers else 0)

    @property
    def made(self) -> int:
        """Number of these evaluations that were made here."""
        return max(self.evaluations - len(self.given), 0)

    @property
    def own(self) -> Tensor:
        """Which of `told` were evaluated here, bools [evaluations]."""
        losses = self.told[1]
        own = torch.ones_like(losses, dtype=torch.bool)
        if len(losses):
            own[self._places] = False
        return own

    @property
    def _places(self) -> list[int]:
        """Where in `told` the evaluations are that the caller had."""
        if self.complete:
            return self.given
        given = set(self.given)
        return [k for k, number in enumerate(sorted(self._numbers)) if number in given]

    def open(self, asked: Tensor, known: Known) -> Tensor:
        """Open the first request: points [K, n], the start first, and those that are known. Return all of them."""
        first = int(known.has_start)
        asked = asked[:1] if known.suffice else asked
        self.requested = points = torch.cat([asked, known.points[first:]])
        self.given, self.opening = [*range(first), *range(len(asked), len(points))], len(points)
        self._numbers, self._values, self._open = list(self.given), known.values, None
        self._note_outputs(known.values)
        return points

    @property
    def _interrupted(self) -> tuple[Tensor, Tensor]:
        """Points [k, n] and losses [k] of the request, whose values are known; none if the loss raises."""
        if self._open is None:
            assert self.requested is not None
            self._open = self.requested[:0], self._batches[0][1][:0]
            with contextlib.suppress(Exception):  # it is in the file, without losses
                self._open = self.requested[sorted(self._numbers)], self._losses(self._sorted())
        return self._open

    def values(self, points: Tensor) -> Tensor:
        """Return the values [K, *out] of points [K, n]; points of the request with known values are not evaluated.

        The request stays open until `note`. Further points may be added to it.
        """
        self.requested, self._open = points, None
        had = set(self._numbers)
        missing = [k for k in range(len(points)) if k not in had]
        if missing:
            numbers, values, error = self._call(points[missing])
            if numbers:
                values = alike([*(one for one in self._outputs[-1:] if len(one)), values])[-1]
                self._note_outputs(values)
                self._values = self._with(values) if self._numbers else values
                self._numbers += [missing[k] for k in numbers]
            if error is not None:
                raise error
        return self._sorted()[: len(points)]

    def _note_outputs(self, values: Tensor) -> None:
        """Note the first output, and whether values [k, *out] are all equal to it."""
        self._first = values[0].clone() if self._first is None else self._first
        if self.early is not None:
            self.early += values[: max(_HELD // max(self._first.numel(), 1) - len(self.early), 0)].clone()
        self._same = self._same and values.shape[1:] == self._first.shape and bool((values == self._first).all())

    def _with(self, values: Tensor) -> Tensor:
        """Return the values of the request with further ones [k, *out]. ValueError if their outputs have other shapes.

        Numbers [k] and a column [k, 1] are the same.
        """
        before, values = alike([self._values, values])
        before = before[:, None] if before.ndim == 1 and values.shape[1:] == (1,) else before
        if before.shape[1:] != values.shape[1:]:
            shapes = f"{list(before.shape[1:])} before, or in known, and {list(values.shape[1:])} now"
            raise ReturnedValueError(
                f"fn must return values of one shape, and known must have this shape, got {shapes}"
            )
        return torch.cat([before, values])

    def note(self, points: Tensor, losses: Tensor) -> None:
        """Add points [K, n] and losses [K] to the record, and close the request."""
        self._outputs = self._with_outputs(len(points))
        self._batches.append((points, losses))
        given = set() if self.complete else set(self.given)
        own = [k for k in range(len(points)) if k not in given]
        self.last = points[own], losses[own]
        self.complete, self.opening = self.complete + len(points), 0
        self.requested, self._numbers, self._values = None, [], self._values[:0]

    def note_known(self) -> None:
        """Add the known values of the request, and close it."""
        if self.requested is None:
            return
        self.given = self._places  # the points that have no value are left out
        self.note(*self._interrupted)

    def keeping(self, untouched: Tensor | None, x: Tensor) -> tuple[Tensor, Tensor]:
        """Return `told`, with the loss NaN wherever an untouched parameter, bools [n], differs from x [n]."""
        points, losses = self.told
        if untouched is None:
            return points, losses
        return points, torch.where((points == x)[:, untouched].all(1), losses, torch.nan)

    def outputs(self, count: int) -> tuple[int, Tensor]:
        """Return the outputs [k, *out] that are kept of the first `count` evaluations, and the number of the first."""
        kept = torch.cat(self._outputs)
        first = self.complete - len(kept)
        return first, kept[: max(count - first, 0)]

    def _with_outputs(self, count: int) -> list[Tensor]:
        """Return the kept outputs with those of a request of `count` points; without earlier ones if they are many."""
        values = self._sorted()
        if not self.keeps_outputs or values.ndim < 2 or len(values) != count:
            return [values.new_empty(0, 0)]
        kept = [one for one in self._outputs if len(one)]
        return [*kept, values] if sum(map(torch.numel, kept)) + values.numel() <= _HELD else [values]

    def mean_at(self, x: Tensor) -> Tensor:
        """Return the mean of the finite losses at a point [n]."""
        points, losses = self.told
        return losses[(points == x).all(1) & torch.isfinite(losses)].mean()

    @property
    def flat(self) -> bool:
        """Whether all values are equal."""
        losses = self.told[1]
        return bool((losses == losses[:1]).all())

    @property
    def has_outputs(self) -> bool:
        """Whether values are outputs of several numbers, which a loss follows."""
        return self._first is not None and self._first.numel() > 1

    @property
    def same_outputs(self) -> bool:
        """Whether there are outputs, and all are equal; False if some are not known any more."""
        return self.has_outputs and self._same

    @property
    def unbounded(self) -> bool:
        """Whether the last request found a loss so low that there seems to be no minimum, see `is_unbounded`."""
        return bool((self.last[1] < -DEEP).any()) and is_unbounded(self.told[1])

    def state_dict(self) -> dict[str, Any]:
        """Everything, for `load_state_dict`."""
        points, losses = _joined(self._batches)
        request = None if self.requested is None else (self.requested, list(self._numbers), self._values)
        own = {"points": points, "values": losses, "request": request, "outputs": torch.cat(self._outputs)}
        return own | ({"given": list(self.given), "opening": self.opening} if self.given else {})

    def load_state_dict(self, state: dict[str, Any], like: Tensor, known: Known | None = None) -> None:
        """Go on from a state, on the device of the start `like` [n].

        ValueError if it has another start or type, or began with other points than those that are `known`, if any.
        """
        points, losses = state["points"], state["values"]
        if points.dtype != like.dtype:
            raise ValueError(f"x0 must be {points.dtype} as there, got {like.dtype}")
        if points.shape[1:] == like.shape and len(points) and not torch.equal(points[0].to(like.device), like):
            raise ValueError(f"x0 must be {short(points[0])} as there, got {short(like)}")
        self._same = not len(points)
        self.given, self.opening = state.get("given", []), state.get("opening", 0)
        self._batches, self.complete = [(points.to(like.device), losses.to(like.device))], len(points)
        self._outputs = [state["outputs"].to(like.device)]
        if state["request"] is not None:
            requested, self._numbers, values = state["request"]
            self.requested, self._values = requested.to(like.device), values.to(like.device)
        if known is not None:
            began = self._batches[0][0] if self.complete or self.requested is None else self.requested
            known.check_same(began[self.given])

    def _sorted(self) -> Tensor:
        """The values that are known [k, *out], in the order of their points."""
        order = sorted(range(len(self._numbers)), key=self._numbers.__getitem__)
        return self._values if order == list(range(len(order))) else self._values[order]


def _joined(batches: Sequence[tuple[Tensor, Tensor]]) -> tuple[Tensor, Tensor]:
    points, losses = zip(*batches, strict=True)
    return torch.cat(points), torch.cat(losses)
