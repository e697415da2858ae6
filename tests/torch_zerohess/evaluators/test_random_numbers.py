"""Workers draw different random numbers, wherever the black box keeps its generators."""

import concurrent.futures
import functools
import multiprocessing
import random
import sys
import types

import black_boxes
import numpy as np
import pytest
import torch

from torch_zerohess.evaluators import Executor, Factory, random_numbers
from torch_zerohess.evaluators.factory import Each
from torch_zerohess.evaluators.random_numbers import draw_apart

Z = torch.zeros(6, 1, dtype=torch.float64)
KINDS = {
    "torch": lambda: torch.Generator().manual_seed(0),
    "numpy": lambda: np.random.default_rng(0),
    "numpy, old": lambda: np.random.RandomState(0),
    "python": lambda: random.Random(0),
}
BOXES = {
    "an attribute": black_boxes.Noisy(),
    "a factory": Factory(black_boxes.Noisy),
    "a global variable": black_boxes.noisy,
    "a global variable of a module": black_boxes.noisy_elsewhere,
    "a module that is imported late": black_boxes.noisy_late,
    "the generator of NumPy": Factory(black_boxes.seeded),
    "one point": Each(black_boxes.noisy_of_one),
}


@pytest.fixture(scope="module")
def executor():
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=context) as workers:
        yield Executor(workers)


@pytest.mark.parametrize("name", BOXES)
def test_workers_of_a_pool_draw_different_numbers(name, pool):
    values = torch.cat([pool(BOXES[name], Z) for _ in range(3)])
    assert len(values.unique()) == len(values)


@pytest.mark.parametrize("name", BOXES)
def test_workers_of_an_executor_draw_different_numbers(name, executor):
    values = torch.cat([executor(BOXES[name], Z) for _ in range(3)])
    assert len(values.unique()) == len(values)


def state(generator):
    if isinstance(generator, torch.Generator):
        return generator.get_state().tolist()
    return repr(generator.getstate() if isinstance(generator, random.Random) else vars_of(generator))


def vars_of(generator):
    bits = getattr(generator, "bit_generator", None) or generator._bit_generator
    return {key: np.asarray(one).tolist() if key != "state" else repr(one) for key, one in bits.state.items()}


class Slotted:
    __slots__ = ("rng",)

    def __init__(self, rng):
        self.rng = rng

    def __call__(self, z):
        return z


def boxes_with(generator):
    """Black boxes that reach a generator in every way there is."""
    module = types.ModuleType("simulator")
    module.rng = generator
    names = {"held": generator, "module": module, "package": types.ModuleType("package")}
    names["package"].sub = module
    code = "def named(z): return held\ndef through(z): return module.rng\ndef inner(z): return [held for _ in z]"
    code += "\ndef below(z): return package.sub.rng"
    exec(code, names)

    def enclosing(z):
        return generator

    def default(z, rng=generator):
        return z

    def by_name(z, *, rng=generator):
        return z

    class OfClass:
        rng = generator

        def __call__(self, z):
            return z

    class ByMethod:
        def __call__(self, z):
            return self.further(z)

        def further(self, z):
            return generator

    class ByProperty:
        @property
        def now(self):
            return generator

        def __call__(self, z):
            return self.now

    slotted = Slotted([{"deep": generator}])
    return [
        *(
            names["named"],
            names["through"],
            names["inner"],
            names["below"],
            ByProperty(),
            enclosing,
            default,
            by_name,
            slotted,
            slotted.__call__,
        ),
        *(functools.partial(default, rng=generator), Each(enclosing), lambda z: enclosing(z)),
        *(OfClass(), ByMethod(), ByMethod().further, lambda z: OfClass.rng),
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_every_way_to_a_generator_is_found(monkeypatch, kind):
    monkeypatch.setattr(random_numbers, "is_worker", lambda: True)
    monkeypatch.setattr(random_numbers, "_global_ones", list)
    before = torch.get_rng_state()
    for fn in boxes_with(generator := KINDS[kind]()):
        earlier = state(generator)
        draw_apart(fn)
        assert state(generator) != earlier, fn
        later = state(generator)
        draw_apart(lambda z: z)  # has none
        assert state(generator) == later
    torch.set_rng_state(before)


@pytest.mark.parametrize(
    "line",
    [
        *("import simulators.one; return simulators.one.rng", "import simulators.one as sim; return sim.rng"),
        *("from simulators import one; return one.rng", "from simulators.one import rng; return rng"),
        *("from . import one; return one.rng", "from .one import rng; return rng"),
    ],
)
def test_generators_of_modules_that_a_function_imports_are_found(monkeypatch, line):
    package, module = types.ModuleType("simulators"), types.ModuleType("simulators.one")
    package.one, module.rng = module, KINDS["numpy"]()
    monkeypatch.setitem(sys.modules, "simulators", package)
    monkeypatch.setitem(sys.modules, "simulators.one", module)
    names = {"__package__": "simulators"}
    exec(f"def late(z): {line}", names)
    assert random_numbers._held_by(names["late"]) == [module.rng]


def test_the_first_call_is_made_again_only_for_a_generator_of_the_black_box(monkeypatch):
    """Torch imports NumPy late, which has a generator with a random seed."""
    monkeypatch.setattr(random_numbers, "is_worker", lambda: True)
    calls, generator = [], KINDS["torch"]()
    for fn, known, count in ((print, [], 1), (Slotted(generator), [generator], 1), (Slotted(generator), [], 2)):
        calls.clear()
        random_numbers.drawn_apart(fn, known, lambda: calls.append(1))
        assert len(calls) == count


def test_generators_here_stay_as_they_are():
    generator = KINDS["torch"]()
    before = state(generator), torch.get_rng_state(), random.getstate(), repr(np.random.get_state())
    for fn in boxes_with(generator):
        draw_apart(fn)
    assert state(generator) == before[0]
    assert torch.equal(torch.get_rng_state(), before[1])
    assert (random.getstate(), repr(np.random.get_state())) == before[2:]


def test_two_generators_of_one_black_box_stay_different(monkeypatch):
    monkeypatch.setattr(random_numbers, "is_worker", lambda: True)
    monkeypatch.setattr(random_numbers, "_global_ones", list)
    before = torch.get_rng_state()
    pair = [torch.Generator().manual_seed(k) for k in (0, 1)]
    draw_apart(functools.partial(max, pair))
    torch.set_rng_state(before)
    assert state(pair[0]) != state(pair[1])


def test_a_black_box_that_holds_itself_and_much_else():
    """A list with a million numbers takes no longer than one with ten thousand."""
    generator = KINDS["torch"]()
    box = types.SimpleNamespace(rows=[[1.0] * 1_000_000, [object() for _ in range(20_000)]], rng=generator)
    box.itself = box
    assert random_numbers._held_by(functools.partial(print, box)) == [generator]


def test_without_numpy(monkeypatch):
    monkeypatch.setattr(random_numbers, "is_worker", lambda: True)
    for name in [one for one in sys.modules if one.partition(".")[0] == "numpy"]:
        monkeypatch.delitem(sys.modules, name)
    before, generator = (torch.get_rng_state(), random.getstate()), KINDS["torch"]()
    earlier = state(generator)
    draw_apart(functools.partial(print, generator))
    torch.set_rng_state(before[0])
    random.setstate(before[1])
    assert state(generator) != earlier


class Lazy(dict):
    """As the parameters of a scene, whose values are made where they are read."""

    __slots__ = ("missing",)

    def values(self):
        raise KeyError("no value yet")


def test_objects_that_mind_being_looked_at():
    generator = KINDS["torch"]()
    assert random_numbers._held_by(functools.partial(print, Lazy(a=1), [generator])) == [generator]
    assert random_numbers._held_by(functools.partial(print, Lazy(a=generator))) == [generator]

    def not_yet(z):
        return late

    assert random_numbers._held_by(functools.partial(not_yet, generator)) == [generator]
    late = None
