"""The points of one call, cut into chunks: what waits, what came back, what failed.

The cuts depend on the number of points alone (with `Ray` on the number of actors, too), and values are put together in
the order of the points. If the black box is deterministic, neither the number of workers nor the order in which they
finish changes a bit. If also the value of a point does not depend on which points share its call, the bits are the same
as in one call with all points.

A chunk that fails is tried again. A chunk that failed too often is cut into its points, and each of them is tried as
often: a point that shares a chunk with one that ends the process is not lost. The value of a point that failed too
often is NaN, and `on_nonfinite` says what becomes of it.

Before the first value of a call, a point that failed is tried again after all others. A black box that fails at many
different points, and has never had a value, fails everywhere: the call is `hopeless`, and ends.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from torch_zerohess.evaluators.single_nan import alike, filled
from torch_zerohess.evaluators.transfer import Part, joined

MOST = 256
"""Chunks of a call."""
_FAILURES = 9
"""Evaluations of single points that may fail before the first value; as many as the retries, if these are more."""


class LostEvaluationError(RuntimeError, ValueError):
    """The black box gave no value of a point: its process ended or took too long, in every try."""


@dataclass
class Chunk:
    """Points `start` to `stop - 1` of a call."""

    start: int
    stop: int
    tries: int = 0

    def __len__(self) -> int:
        return self.stop - self.start


def cut(count: int, most: int = MOST) -> list[Chunk]:
    """Return chunks of `count` points, of equal size but for the last one."""
    size = max(1, -(-count // most))
    return [Chunk(start, min(start + size, count)) for start in range(0, count, size)]


@dataclass
class Batch:
    """The state of one call."""

    points: Tensor
    """[K, n]."""
    retries: int
    """Further tries of a chunk, and of a point, after one that failed."""
    most: int = MOST
    """Chunks of the call."""
    waiting: deque[Chunk] = field(default_factory=deque)
    busy: set[int] = field(default_factory=set)
    """Where the chunks start that are being evaluated."""
    lost: dict[int, str] = field(default_factory=dict)
    """Points without a value, and why."""
    _failures: list[str] = field(default_factory=list)
    """Why evaluations of single points failed."""
    _first: set[int] | None = None
    """Starts of the chunks that were running at the first failure and have not failed yet.

    `hopeless` waits for them.
    """
    _values: dict[int, Part] = field(default_factory=dict)
    _error: tuple[int, BaseException] | None = None

    def __post_init__(self) -> None:
        self.waiting.extend(cut(len(self.points), self.most))

    @property
    def finished(self) -> bool:
        """Whether nothing remains to be done: all points are known, or the first error is."""
        return not self.waiting and not (self.busy if self._error is None else self._before_error)

    @property
    def hopeless(self) -> bool:
        """Whether evaluations of single points failed, without a value, more often than they may.

        Those that were under way at the first failure are waited for: they may take longer than those that fail.
        """
        many = len(self._failures) > max(_FAILURES, self.retries)
        return many and not self._first and not self._values and self._error is None

    @property
    def _before_error(self) -> list[int]:
        assert self._error is not None
        return [start for start in self.busy if start < self._error[0]]

    @property
    def known(self) -> dict[int, Tensor]:
        """Values [*out] that have come, by the number of their point."""
        return {start + k: one for start, values in list(self._values.items()) for k, one in enumerate(values.tensor())}

    def take(self) -> Chunk:
        """Return the next chunk, which is busy from now on."""
        chunk = self.waiting.popleft()
        self.busy.add(chunk.start)
        return chunk

    def came(self, chunk: Chunk, values: Part) -> None:
        """Keep the values of a chunk."""
        self.busy.discard(chunk.start)
        self._values[chunk.start] = values

    def failed(self, chunk: Chunk, reason: str) -> None:
        """Try a chunk again, or cut it, or give up its point."""
        self.busy.discard(chunk.start)
        if self._error is not None and chunk.start > self._error[0]:
            return
        chunk.tries += 1
        self._first = (set(self.busy) if self._first is None else self._first) - {chunk.start}
        if len(chunk) == 1:
            self._failures.append(reason)
        if chunk.tries <= self.retries:
            other = len(chunk) == 1 and not self._values  # what another point does tells more
            (self.waiting.append if other else self.waiting.appendleft)(chunk)
        elif len(chunk) > 1:
            self.waiting.extendleft(Chunk(k, k + 1) for k in reversed(range(chunk.start, chunk.stop)))
        else:
            times = "" if chunk.tries == 1 else f" in each of {chunk.tries} tries"
            self.lost[chunk.start] = reason + times

    def raised(self, chunk: Chunk, error: BaseException) -> None:
        """Keep the error of the first chunk that has one: which one it is does not depend on who is faster."""
        self.busy.discard(chunk.start)
        if self._error is None or chunk.start < self._error[0]:
            self._error = chunk.start, error
            self.waiting = deque(one for one in self.waiting if one.start < chunk.start)

    def result(self, known: tuple[torch.dtype, torch.Size] | None = None) -> Tensor:
        """Return values [K, *out], NaN where points were lost.

        known: type and shape [*out] of earlier values.

        Raises the first error of the black box; ValueError if chunks have different shapes; `LostEvaluationError` if
        all points are lost and the shape of a value is not known.
        """
        if self._error is not None:
            raise self._error[1]
        parts = sorted(self._values.items())
        if not parts:
            if known is None:
                raise self.loss()
            return torch.full((len(self.points), *known[1]), torch.nan, dtype=known[0], device="cpu")
        found = [values for _, values in parts]
        if len({one.shape[1:] for one in found}) > 1:
            found = [Part.of(one) for one in alike([one.tensor() for one in found])]
        for start, values in zip((start for start, _ in parts), found, strict=True):
            if values.shape[1:] != found[0].shape[1:]:
                raise ValueError(
                    f"fn must return values of one shape, got {list(found[0].shape[1:])} for point {parts[0][0]} and "
                    f"{list(values.shape[1:])} for point {start}, [{numbers(self.points[start])}]"
                )
        some = joined(found)
        if known is not None:
            some = filled(some, torch.empty(0, *known[1], dtype=known[0], device="cpu"))
        if not self.lost:
            return some
        rows = torch.tensor([k for k in range(len(self.points)) if k not in self.lost], device="cpu")
        return some.new_full((len(self.points), *some.shape[1:]), torch.nan).index_copy_(0, rows, some)

    def loss(self) -> LostEvaluationError:
        """Return the error for a call without any value."""
        if self.hopeless:
            return LostEvaluationError(
                f"fn has no value in any of {len(self._failures)} evaluations of these {len(self.points)} points: "
                f"{self._failures[0]}. To see why, call it in a program of its own, at [{numbers(self.points[0])}]. "
                f"{_MORE}"
            )
        return LostEvaluationError(f"{_first_lost(self.lost, self.points)}; no point has a value. {_MORE}")


_MORE = "An evaluator with more retries, such as evaluator=ProcessPool(retries=9), tries each point more often"


def loss_error(lost: dict[int, str], points: Tensor) -> LostEvaluationError:
    """Return the error for points [K, n], of which those with the numbers `lost` have no value, but others have."""
    return LostEvaluationError(
        f"{_first_lost(lost, points)}; {len(lost)} without a value. on_nonfinite='drop' or a number goes on without "
        f"them. {_MORE}"
    )


def _first_lost(lost: dict[int, str], points: Tensor) -> str:
    first = min(lost)
    return f"{lost[first]}, at the point [{numbers(points[first])}], number {first} of {len(points)}"


def numbers(point: Tensor | Sequence[float]) -> str:
    """Return the first coordinates of a point as text."""
    values = [float(one) for one in point[:8]]
    return ", ".join(f"{one:.6g}" for one in values) + (", ..." if len(point) > 8 else "")
