"""Evaluation in this process, and the interface of every evaluator."""

import concurrent.futures
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Protocol, TypeVar

from torch import Tensor

from torch_zerohess.evaluators.values import checked_values
from torch_zerohess.precision import without_autocast, without_graph

E = TypeVar("E", bound="Closing")


class Evaluator(Protocol):
    """Calls a black box on a batch of points, in any process and order; results are in the order of the points.

    An evaluator that gives up points, whose values are then NaN, says so in an attribute `lost`: the numbers of these
    points in the last call, and why. One that calls fn with single points has `single_points`: the largest number of
    points of which it does so. One that can begin further calls before the first has ended has
    `submit(fn, points, *aux)`, which returns a `concurrent.futures.Future` of the values. Where a call fails whose
    first values are known, its exception carries them, see `evaluators.partial_values`.
    """

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Any:
        """Return fn(points [K, n], *aux [K, ...]), values of K points."""


class Evaluation(concurrent.futures.Future[Tensor]):
    """The values [K, *out] of a call that was submitted."""

    lost: dict[int, str] = {}  # noqa: RUF012
    """Points without a value, by number, and why; complete when the future is done."""

    @classmethod
    def of(cls, call: Callable[[], Tensor]) -> "Evaluation":
        """Return a future that is done, with what `call` returns or raises; Ctrl-C is raised here."""
        future = cls()
        future.set_running_or_notify_cancel()
        future.settle(call)
        if isinstance(error := future.exception(), KeyboardInterrupt):
            raise error
        return future

    def settle(self, call: Callable[[], Tensor]) -> None:
        """Take what `call` returns or raises."""
        try:
            values = call()
        except BaseException as error:  # SystemExit too: whoever waits must hear of it
            self.set_exception(error)
        else:
            self.set_result(values)


class Closing:
    """A context manager that ends with `close()`."""

    def close(self) -> None:
        """Give back what the evaluator holds; closing twice is no error."""

    def __enter__(self: E) -> E:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class Inline(Closing):
    """Calls the black box in this process, all points at once, without autograd.

    It holds nothing, so `close()` changes nothing: unlike a pool it can still be called.

    Example:
        >>> import torch
        >>> with Inline() as evaluator:
        ...     evaluator(lambda z: z.sum(1), torch.ones(2, 3))
        tensor([3., 3.])
    """

    def __repr__(self) -> str:
        return "Inline()"

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Any:
        with without_graph(), without_autocast(points.device):
            return fn(points, *aux)

    def submit(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Evaluation:
        """Call at once, and return a future that is done: see `ProcessPool.submit`, for which this stands in.

        As there, fn has its own copy of the points, and the values are a copy of what fn returned.
        """
        own = [one.detach().clone() for one in (points, *aux)]
        return Evaluation.of(lambda: checked_values(self(fn, *own), points).clone())


def values_without_points(fn: Callable[..., Any], points: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return values [0, *out] of fn, called in this process: points [0, n] and aux [0, ...] need no worker."""
    return checked_values(Inline()(fn, points.detach(), *aux), points)
