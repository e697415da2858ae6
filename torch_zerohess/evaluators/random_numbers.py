"""Random numbers of black boxes in workers: every process draws its own, and a black box without noise stays so.

Every worker gets the same black box, so its generators begin with the same state. Workers would draw alike, and the
noise of repeated values would look smaller than it is. But a black box may also draw from a copy of a generator in
every call, or draw a table in its first call: then equal draws are what makes it a function.

So a worker seeds only the generators of the process at once: those of torch, and behind the functions of `random` and
`numpy.random`. A generator that the black box holds keeps its state until a call has drawn from it. It then gets a seed
of the worker, and this call is made again. What the first of the two calls has drawn and keeps, such as a table, is the
same in all workers, and as with `Inline`.
"""

import collections
import contextlib
import functools
import inspect
import itertools
import random
import sys
import types
from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

import torch
from torch import Tensor

from torch_zerohess.evaluators.factory import Each, Factory
from torch_zerohess.evaluators.process_identity import digest, is_worker

T = TypeVar("T")

_DEPTH = 8
_MOST = 10_000
"""Objects that are looked at, and parts of one object: a black box may hold a long list."""
_PLAIN = str | bytes | int | float | Tensor | None
"""Types of objects that hold no generator."""
_LIBRARIES = "torch", "numpy"
"""Packages whose classes and functions hold no generator but the global ones."""
_numbers = itertools.count()
"""Of seeds: an executor may send a black box again, as it was at first."""


class Apart:
    """Calls of a black box, in a worker with random numbers of this process. A `Factory` is built first.

    The generators that a black box holds are those of torch, NumPy and Python in what fn holds, and in the global
    variables and modules that its code names. Others, as inside of a C++ library, are the black box's own affair.
    """

    def __init__(self, fn: Callable[..., Any]) -> None:
        self._fn = _built(fn)
        self._waiting: list[Any] = []
        """Generators that fn holds, and that no call has drawn from."""
        self._called = not is_worker()
        if is_worker():
            torch.manual_seed(_next_seed() >> 1)  # on every device
            for generator in _global_ones():
                _reseed(generator)
            self._waiting = _held_by(self._fn)

    def call(self, evaluate: Callable[[], T], again: Callable[[], object] = lambda: None) -> T:
        """Return evaluate(), a call of the black box, made again where a generator had to be seeded meanwhile.

        A module that fn imports when it is first called may have a generator, too. Whether the first call has drawn
        from it is not known. So the call is made again, to see.

        again: called before each further evaluation.
        """
        while True:
            waiting = [(one, _state(one)) for one in self._waiting]
            result = evaluate()
            drew = [one for one, before in waiting if not _same(_state(one), before)]
            new = list[Any]()
            if not self._called:
                self._called = True
                new = [one for one in _held_by(self._fn) if not _among(self._waiting, one)]
            if not drew and not new:
                return result
            for generator in drew:
                _reseed(generator)
            self._waiting = [one for one in self._waiting if not _among(drew, one)] + new
            again()


def _among(things: list[Any], thing: Any) -> bool:
    return any(one is thing for one in things)


def _built(fn: Callable[..., Any]) -> Callable[..., Any]:
    """Return the black box of many points or of one that a `Factory` makes, or that is given."""
    while isinstance(fn, Each):
        fn = fn.fn
    return fn.build() if isinstance(fn, Factory) else fn


def _global_ones() -> Iterator[Any]:
    """Return the generators behind the functions of `random` and `numpy.random`."""
    yield random.seed.__self__  # type: ignore[attr-defined]
    if "numpy.random" in sys.modules:
        yield sys.modules["numpy.random"].mtrand._rand


def _held_by(fn: Callable[..., Any]) -> list[Any]:
    """Return the generators that can be reached from a black box, in an order that is the same in all processes."""
    found, waiting = list[Any](), collections.deque([(fn, _DEPTH)])
    seen = dict[int, Any]()  # what is seen is kept: the number of an object that is gone may be that of another one
    while waiting and len(seen) < _MOST:
        thing, depth = waiting.popleft()
        if id(thing) in seen:
            continue
        seen[id(thing)] = thing
        if _is_generator(thing):
            found.append(thing)
        elif depth:
            with contextlib.suppress(Exception):  # what a foreign object does where it is looked at
                parts = itertools.islice(_parts(thing), _MOST)
                waiting += [(part, depth - 1) for part in parts if not isinstance(part, _PLAIN)]
    return found


def _parts(thing: Any) -> Iterator[Any]:
    """Return the objects that a thing consists of, and for code those that it names."""
    if isinstance(thing, dict):
        yield from dict.values(thing)
    elif isinstance(thing, list | tuple | set | frozenset):
        yield from thing
    elif isinstance(thing, functools.partial):
        yield from (thing.func, thing.args, thing.keywords)
    elif _is_of_a_library(thing):
        return
    elif isinstance(thing, types.FunctionType):
        yield from _of_code(thing.__code__, thing.__globals__)
        yield from (thing.__defaults__, thing.__kwdefaults__)
        yield from inspect.getclosurevars(thing).nonlocals.values()  # ValueError before all of them are assigned
    elif isinstance(thing, types.MethodType):
        yield from (thing.__self__, thing.__func__)
    elif isinstance(thing, property):
        yield thing.fget
    elif not isinstance(thing, type | types.ModuleType):
        yield getattr(thing, "__dict__", None)
        yield from (getattr(thing, name, None) for one in type(thing).__mro__ for name in _slots(one))
        yield from (part for one in type(thing).__mro__ if not _is_of_a_library(one) for part in vars(one).values())
    elif isinstance(thing, type):
        yield from vars(thing).values()


def _is_of_a_library(thing: Any) -> bool:
    """Whether a class or a function belongs to torch or NumPy."""
    return isinstance(thing, type | types.FunctionType) and str(thing.__module__).partition(".")[0] in _LIBRARIES


def _slots(kind: type) -> tuple[str, ...]:
    names = vars(kind).get("__slots__", ())
    return (names,) if isinstance(names, str) else tuple(names)


def _of_code(code: types.CodeType, names: Mapping[str, Any]) -> Iterator[Any]:
    """Return the global variables that code names, also of modules: `pkg.sim.rng` of the module pkg.sim.

    A name that is no global variable may be a module that the code imports.
    """
    package = str(names.get("__package__") or "")
    homes = itertools.accumulate(package.split("."), "{}.{}".format) if package else ()  # of `from .sim import rng`
    prefixes = ["", *(f"{one}." for one in homes)]
    inside = [one for one in code.co_names if one not in names]
    imported = (sys.modules.get(f"{prefix}{one}".rstrip(".")) for prefix in prefixes for one in inside)
    modules, seen = list[types.ModuleType](), set[int]()
    for thing in (*(names.get(one) for one in code.co_names), *imported):
        if isinstance(thing, types.ModuleType):
            modules.append(thing)
        else:
            yield thing
    for module in modules:  # it grows
        if id(module) in seen or module.__name__.partition(".")[0] in _LIBRARIES:
            continue
        seen.add(id(module))
        for thing in (vars(module).get(one) for one in code.co_names):
            if isinstance(thing, types.ModuleType):
                modules.append(thing)
            else:
                yield thing
    yield from (part for one in code.co_consts if isinstance(one, types.CodeType) for part in _of_code(one, names))


def _is_generator(thing: Any) -> bool:
    if isinstance(thing, torch.Generator | random.Random):
        return True
    numpy = sys.modules.get("numpy")
    return numpy is not None and isinstance(thing, numpy.random.Generator | numpy.random.RandomState)


def _state(generator: Any) -> Any:
    """Return the state of a generator, None if it has none, as a generator of the operating system."""
    with contextlib.suppress(Exception):
        if isinstance(generator, torch.Generator):
            return generator.get_state()
        if isinstance(generator, random.Random):
            return generator.getstate()
        bits = getattr(generator, "bit_generator", None)
        return generator.get_state(legacy=False) if bits is None else bits.state
    return None


def _same(first: Any, second: Any) -> bool:
    """Whether two states are equal; those of NumPy are dictionaries with arrays in them."""
    if isinstance(first, Tensor):
        return torch.equal(first, second)
    if isinstance(first, dict):
        return all(_same(one, second[key]) for key, one in first.items())
    equal = first == second
    return bool(equal.all()) if hasattr(equal, "all") else bool(equal)


def _reseed(generator: Any) -> None:
    seed = _next_seed()
    if isinstance(generator, torch.Generator):
        generator.manual_seed(seed >> 1)
    elif isinstance(generator, random.Random):
        generator.seed(seed)
    elif (bits := getattr(generator, "bit_generator", None)) is not None:
        bits.state = type(bits)(seed).state
    else:  # normal numbers are drawn in pairs, and the state keeps the second one
        generator.set_state(type(generator._bit_generator)(seed).state | {"has_gauss": 0, "gauss": 0.0})


def _next_seed() -> int:
    """Return a seed of 64 bits that no other generator in any process has."""
    return digest(f"generator {next(_numbers)}".encode())
