"""Methods of an object that no other thread interrupts."""

import functools
import threading
from collections.abc import Callable
from typing import Concatenate, ParamSpec, Protocol, TypeVar


class Locking(Protocol):
    """What such an object has."""

    lock: threading.RLock


_S = TypeVar("_S", bound=Locking)
_P = ParamSpec("_P")
_T = TypeVar("_T")


def locked(method: Callable[Concatenate[_S, _P], _T]) -> Callable[Concatenate[_S, _P], _T]:
    """Return a method that no other thread interrupts: it waits for a call that is under way."""

    @functools.wraps(method)
    def called(self: _S, /, *args: _P.args, **kwargs: _P.kwargs) -> _T:
        with self.lock:
            return method(self, *args, **kwargs)

    return called
