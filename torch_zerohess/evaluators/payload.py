"""A black box as bytes for another process, and what to say where it cannot be that."""

import contextlib
import functools
import pickle
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from torch_zerohess.evaluators.factory import Each, Factory

_DEPTH = 6


def dumped(fn: Callable[..., Any]) -> bytes:
    """Return fn as bytes, or raise TypeError that names the object in it that cannot be pickled."""
    try:
        return pickle.dumps(fn)
    except (pickle.PicklingError, TypeError, AttributeError, ValueError, RuntimeError, NotImplementedError) as error:
        while isinstance(fn, Each):
            fn = fn.fn
        path, thing = _culprit(fn, "make" if isinstance(fn, Factory) else "fn", _DEPTH)
        raise TypeError(
            f"{path} must be picklable to be sent to another process, got {thing!r} ({error}): put the function at "
            "the top of a module, or pass Factory(make, *args) with such a make, which makes the rest in the worker"
        ) from error


def _culprit(thing: Any, path: str, depth: int) -> tuple[str, Any]:
    """Return the innermost object that cannot be pickled, and the way to it."""
    for step, part in _parts(thing, path) if depth else ():
        if not _picklable(part):
            return _culprit(part, step, depth - 1)
    return path, thing


def _picklable(thing: Any) -> bool:
    try:
        pickle.dumps(thing)
    except Exception:
        return False
    return True


def _parts(thing: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(thing, Factory):
        yield "make", thing.make
        yield from ((f"args[{k}] of Factory", one) for k, one in enumerate(thing.args))
        yield from ((f"argument {name!r} of Factory", one) for name, one in thing.kwargs.items())
    elif isinstance(thing, functools.partial):
        yield f"{path}.func", thing.func
        yield from ((f"{path}.args[{k}]", one) for k, one in enumerate(thing.args))
        yield from ((f"{path}.keywords[{name!r}]", one) for name, one in thing.keywords.items())
    elif isinstance(thing, Mapping):
        yield from ((f"{path}[{name!r}]", one) for name, one in thing.items())
    elif isinstance(thing, (list, tuple)):
        yield from ((f"{path}[{k}]", one) for k, one in enumerate(thing))
    elif hasattr(thing, "__self__"):
        yield f"{path}.__self__", thing.__self__
    elif not isinstance(thing, type) and not hasattr(thing, "__code__"):
        yield from ((f"{path}.{name}", one) for name, one in getattr(thing, "__dict__", {}).items())


class RemoteTraceback(Exception):
    """The traceback of an error in a worker, as the cause of the same error in the caller."""

    def __init__(self, text: str) -> None:
        super().__init__(text)
        self.text = text

    def __str__(self) -> str:
        return f'\n"""\n{self.text}"""'


def dumped_error(error: BaseException, text: str, dumps: Callable[[Any], bytes] = pickle.dumps) -> bytes:
    """Return an error and its traceback as bytes; a RuntimeError that names it, if it cannot be sent itself.

    dumps: writes what `pickle.loads` reads.
    """
    text = text[-30_000:]
    with contextlib.suppress(Exception):  # whatever the pickling of a foreign error does
        data = dumps((error, text))
        pickle.loads(data)
        if len(data) < 60_000:
            return data
    return pickle.dumps((RuntimeError(f"{type(error).__name__}: {error}"[:2000]), text))


def loaded_error(data: bytes) -> BaseException:
    """Return the error of `dumped_error`, with the worker's traceback as its cause."""
    error, text = pickle.loads(data)
    error.__cause__ = RemoteTraceback(text)
    return error
