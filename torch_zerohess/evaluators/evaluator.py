"""The interface of every evaluator, and the future that it returns."""

import concurrent.futures
from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, TypeVar

from torch import Tensor

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


class EvaluationFuture(concurrent.futures.Future[Tensor]):
    """The values [K, *out] of a call that was submitted."""

    lost: dict[int, str] = {}  # noqa: RUF012
    """Points without a value, by number, and why; complete when the future is done."""

    @classmethod
    def of(cls, call: Callable[[], Tensor]) -> "EvaluationFuture":
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
