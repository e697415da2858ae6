"""Evaluation in this process, and what every evaluator is."""

from collections.abc import Callable
from types import TracebackType
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

E = TypeVar("E", bound="Closing")


class Evaluator(Protocol):
    """Calls a black box on a batch of points, in any process and order; results are in the order of the points.

    An evaluator that gives up points, whose values are then NaN, says so in an attribute `lost`: the numbers of these
    points in the last call, and why.
    """

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Any:
        """Return fn(points [K, n], *aux [K, ...]), values of K points."""


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

    Example:
        >>> with Inline() as evaluator:
        ...     evaluator(lambda z: z.sum(1), torch.ones(2, 3))
        tensor([3., 3.])
    """

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Any:
        with torch.no_grad():
            return fn(points, *aux)
