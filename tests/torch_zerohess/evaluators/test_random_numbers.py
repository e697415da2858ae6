"""Workers draw different random numbers, wherever the black box keeps its generators, and change no fixed ones."""

import concurrent.futures
import functools
import pickle
import random
import sys
import types

import black_boxes
import cloudpickle
import numpy as np
import pytest
import torch

from torch_zerohess.evaluators import Executor, Factory, Inline, ProcessPool, random_numbers
from torch_zerohess.evaluators import executor as executor_module
from torch_zerohess.evaluators.factory import Each
from torch_zerohess.evaluators.random_numbers import Apart
from torch_zerohess.evaluators.worker_process import Process

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
    "pairs of numbers": black_boxes.Paired(),
    "from the third call on": black_boxes.AfterAWhile(),
}
FIXED = {
    "a copy in every call": black_boxes.Common,
    "a copy of one that is imported late": lambda: black_boxes.common_late,
    "a table of the first call": black_boxes.Tabulated,
    "a seed in every call": black_boxes.Restarted,
}


@pytest.fixture(scope="module")
def executor(forking):
    with concurrent.futures.ProcessPoolExecutor(2, mp_context=forking) as workers:
        yield Executor(workers)


@pytest.mark.parametrize("name", BOXES)
def test_workers_of_a_pool_draw_different_numbers(name, pool):
    values = torch.cat([pool(BOXES[name], Z) for _ in range(3)])
    assert len(values.unique()) == len(values)


@pytest.mark.parametrize("name", BOXES)
def test_workers_of_an_executor_draw_different_numbers(name, executor):
    values = torch.cat([executor(BOXES[name], Z) for _ in range(3)])
    assert len(values.unique()) == len(values)


@pytest.mark.parametrize("name", FIXED)
def test_workers_leave_fixed_random_numbers_as_they_are(name, pool, executor):
    points = black_boxes.points(12, 1)
    expected = Inline()(FIXED[name](), points)
    for workers in (pool, executor):
        fn = FIXED[name]()
        for _ in range(2):
            assert torch.equal(workers(fn, points), expected)


@pytest.mark.usefixtures("quick_workers")
def test_the_time_of_an_evaluation_that_is_made_again_begins_anew(monkeypatch):
    begun, begin = [], Process._begin
    monkeypatch.setattr(Process, "_begin", lambda one: (begin(one), begun.append(one.deadline)))
    with ProcessPool(1, timeout=1e6) as pool:
        pool(black_boxes.Noisy(), Z[:3])
    assert len(begun) == 4
    assert begun == sorted({*begun})


def test_an_executor_knows_a_black_box_with_a_generator_again():
    """The pickled form of a generator has an address in it. What it holds is not told from the same black box."""
    fn, kept = black_boxes.Noisy(), []
    for pickler in (pickle.Pickler, cloudpickle.Pickler):
        first = executor_module._state(fn, pickler)
        kept.append(fn.generator.get_state())  # which takes the address
        assert first == executor_module._state(fn, pickler) != b""
        fn(Z)
        assert executor_module._state(fn, pickler) != first


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


def drawn(generator):
    """Draw a number of a generator of any kind, as a black box does."""
    if isinstance(generator, torch.Generator):
        return float(torch.rand((), generator=generator))
    return generator.random()


def calls_of(fn, *generators, times=1):
    """Return what the evaluations of some calls draw in a worker."""
    values = []
    apart = Apart(fn)
    for _ in range(times):
        apart.call(lambda: values.append([drawn(one) for one in generators]))
    return values


@pytest.fixture
def as_worker(monkeypatch):
    monkeypatch.setattr(random_numbers, "is_worker", lambda: True)
    monkeypatch.setattr(random_numbers, "_global_ones", list)
    before = torch.get_rng_state()
    yield
    torch.set_rng_state(before)


@pytest.mark.usefixtures("as_worker")
@pytest.mark.parametrize("kind", KINDS)
def test_every_way_to_a_generator_is_found(kind):
    first = drawn(KINDS[kind]())
    for number, fn in enumerate(boxes_with(KINDS[kind]())):
        fn = boxes_with(generator := KINDS[kind]())[number]
        values = calls_of(fn, generator, times=2)
        assert values[0] == [first], fn  # as in every other process
        assert len(values) == 3, fn  # the first call again, and the second
        again = KINDS[kind]()
        expected = [drawn(again) for _ in range(3)]
        assert values[1][0] not in expected, fn
        assert values[2][0] not in expected, fn


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


@pytest.mark.usefixtures("as_worker")
def test_a_call_is_made_again_only_where_a_generator_of_the_black_box_was_drawn_from():
    generator, calls = KINDS["torch"](), []
    apart, again = Apart(Slotted(generator)), []

    def call(draws):
        calls.clear()
        again.clear()
        apart.call(lambda: calls.append(drawn(generator) if draws else 0), lambda: again.append(1))
        assert len(again) == len(calls) - 1
        return len(calls)

    assert [call(one) for one in (False, False, True, True, False)] == [1, 1, 2, 1, 1]


@pytest.mark.usefixtures("as_worker")
def test_a_generator_that_comes_with_the_first_call_is_waited_for():
    """Whether the first evaluation has drawn from it is not known. A box that makes one in every call ends, too."""
    for draws, count in ((False, 2), (True, 3)):
        box, calls = Slotted(None), []
        box.rng = None

        def evaluate(box=box, calls=calls, draws=draws):
            box.rng = box.rng or KINDS["torch"]()
            calls.append(drawn(box.rng) if draws else 0)

        Apart(box).call(evaluate)
        assert len(calls) == count
    box, calls = Slotted(None), []

    def evaluate_anew():
        box.rng = KINDS["torch"]()
        calls.append(drawn(box.rng))

    Apart(box).call(evaluate_anew)
    assert len({*calls}) == 1


@pytest.mark.usefixtures("as_worker")
def test_a_generator_without_a_state_is_left_alone():
    generator = random.SystemRandom()
    assert len(calls_of(Slotted(generator), generator)) == 1


def test_generators_here_stay_as_they_are():
    generator = KINDS["torch"]()
    before = state(generator), torch.get_rng_state(), random.getstate(), repr(np.random.get_state())
    for fn in boxes_with(generator):
        Apart(fn).call(lambda: None)
    assert state(generator) == before[0]
    assert len(calls_of(Slotted(generator), generator)) == 1
    assert torch.equal(torch.get_rng_state(), before[1])
    assert (random.getstate(), repr(np.random.get_state())) == before[2:]


@pytest.mark.usefixtures("as_worker")
def test_two_generators_of_one_black_box_stay_different():
    pair = [torch.Generator().manual_seed(k) for k in (0, 1)]
    calls_of(functools.partial(max, pair), *pair)
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
    values = calls_of(functools.partial(print, generator), generator)
    torch.set_rng_state(before[0])
    random.setstate(before[1])
    assert len(values) == 2


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
