"""Black boxes that are made where they are called, and black boxes of one point."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.evaluators.batch import numbers
from torch_zerohess.evaluators.partial_values import keep_finished
from torch_zerohess.evaluators.single_nan import alike, without_output
from torch_zerohess.evaluators.values import as_tensor


class Factory:
    """A black box that is made in the process that calls it: `make(*args, **kwargs)` returns it.

    Every process that evaluates a `Factory` calls `make` once, and keeps what it returns. So a scene, a session or a
    program need not be picklable. `make` and its arguments must be. A worker keeps four black boxes, those that were
    used last, and calls `make` again for one that it has not kept.

    Args:
        make: a function or class at the top of a module.
        *args: its arguments.
        **kwargs: its arguments by name.

    Raises:
        TypeError: `make`, or what it returns, is not callable.

    Example:
        >>> import operator
        >>> row_sums = Factory(operator.methodcaller, "sum", 1)
        >>> row_sums(torch.ones(2, 3))
        tensor([3., 3.])
    """

    def __init__(self, make: Callable[..., Callable[..., Any]], *args: Any, **kwargs: Any) -> None:
        if not callable(make):
            raise TypeError(f"make must be callable and return a black box, got {make!r}")
        self.make, self.args, self.kwargs = make, args, kwargs
        self._lock = threading.Lock()
        self._made: Callable[..., Any] | None = None

    def __repr__(self) -> str:
        return f"Factory({getattr(self.make, '__name__', self.make)})"

    @property
    def takes_batches(self) -> bool:
        """Whether `make` is a class whose black boxes take batches by construction."""
        return bool(getattr(self.make, "takes_batches", False))

    def build(self) -> Callable[..., Any]:
        """Return the black box of this process; the first call makes it."""
        with self._lock:
            if self._made is None:
                made = self.make(*self.args, **self.kwargs)
                if not callable(made):
                    raise TypeError(f"make must return a black box, which is callable, got {made!r} from {self!r}")
                self._made = made
            return self._made

    def __call__(self, points: Tensor, *aux: Tensor) -> Any:
        """Evaluate the black box at points [K, n]."""
        return (self._made or self.build())(points, *aux)

    def __getstate__(self) -> dict[str, Any]:
        return {"make": self.make, "args": self.args, "kwargs": self.kwargs}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__init__(state["make"], *state["args"], **state["kwargs"])  # type: ignore[misc]


@dataclass(frozen=True)
class Each:
    """A black box of one point, [n] and aux [...] -> [*out], as one of many."""

    fn: Callable[..., Any]

    def __call__(self, points: Tensor, *aux: Tensor) -> Tensor:
        values: list[Tensor] = []
        shape: torch.Size | None = None
        try:
            for one in zip(points, *aux, strict=True):
                value = as_tensor(self.fn(*one))
                if not without_output(value[None]):
                    if shape is not None and value.shape != shape:
                        raise ValueError(
                            f"fn must return the same shape for every point, got {list(value.shape)} at the point "
                            f"[{numbers(one[0])}] and {list(shape)} before"
                        )
                    shape = value.shape
                values.append(value.clone())  # fn may go on writing to what it returned
        except BaseException as error:  # Ctrl-C, too
            keep_finished(error, points, dict(enumerate(values)))
            raise
        return torch.cat(alike([one[None] for one in values]))


def same(first: Callable[..., Any] | None, second: Callable[..., Any]) -> bool:
    """Whether two black boxes are the same object; a bound method is a new object at each access."""
    if isinstance(first, Each) and isinstance(second, Each):
        return same(first.fn, second.fn)
    owner = getattr(first, "__self__", None)
    if owner is not None and owner is getattr(second, "__self__", None):
        own = getattr(first, "__func__", first)
        return own is getattr(second, "__func__", second)
    return first is second
