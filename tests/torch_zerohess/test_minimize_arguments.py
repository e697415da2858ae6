"""What `minimize` refuses: the error names the argument and its value, and comes before the first evaluation."""

import inspect
import itertools
import math
import re
import typing

import numpy as np
import pytest
import torch
from searches import tilted, zeros

import torch_zerohess as zh
from torch_zerohess.evaluators import ProcessPool
from torch_zerohess.search.protocol.space import Bounds

TWO_WAYS = (
    r"can be read in two ways, got .*: write \[\(-1, 1\), \(0, 9\)\] if each parameter has a pair, "
    r"or \[\(-1, 0\), \(1, 9\)\] if lower = \[-1, 1\] and upper = \[0, 9\]"
)
REFUSED = [
    ({"engine": "newton"}, ValueError, "engine must be one of .*, got 'newton'"),
    ({"x0": ["a", 0.0]}, ValueError, r"x0 must be a tensor, an array or a list of n numbers, got \['a', 0.0\]"),
    (
        {"x0": zeros(2) + 1j},
        ValueError,
        r"x0 must be a tensor \[n\], float32 or float64, got one of shape \[2\], torch.complex128",
    ),
    (
        {"x0": np.zeros(2) + 1j},
        ValueError,
        r"x0 must be a tensor \[n\], float32 or float64, got one of shape \[2\], torch.complex128",
    ),
    (
        {"x0": torch.zeros(2, 2)},
        ValueError,
        r"x0 must be a tensor \[n\], float32 or float64, got one of shape \[2, 2\]",
    ),
    ({"maxiter": 5}, TypeError, "no argument maxiter; did you mean max_evaluations"),
    ({"restart": 5}, TypeError, "no argument restart; did you mean restarts"),
    ({"constraints": []}, TypeError, r"no argument constraints; did you mean loss: .* y\[0\] \+ 50 \* y\[1:\]\.clamp"),
    ({"qqq": 5}, TypeError, "no argument qqq; there are"),
    ({"max_evaluations": None}, TypeError, "max_evaluations must be an integer, got None"),
    ({"max_evaluations": 1e3}, TypeError, "max_evaluations must be an integer, got 1000.0"),
    ({"batch": "a"}, TypeError, "batch must be an integer, got 'a'"),
    ({"batch": 0}, ValueError, "batch must be at least 1, got 0"),
    ({"xtol": -1.0}, ValueError, "xtol must be at least 0, got -1.0"),
    ({"xtol": "a"}, TypeError, "xtol must be a number, got 'a'"),
    ({"ftol": math.nan}, ValueError, "ftol must be at least 0, got nan"),
    ({"time_limit": "1"}, TypeError, "time_limit must be a number, got '1'"),
    ({"target": math.nan}, ValueError, "target must be a number, got nan"),
    ({"callback": 5}, TypeError, "callback must be callable, got 5"),
    ({"evaluator": 5}, TypeError, "evaluator must be callable, got 5"),
    ({"evaluator": ProcessPool}, TypeError, "evaluator must be an object, got the class ProcessPool: write"),
    ({"vectorized": "no"}, TypeError, "vectorized must be True or False, got 'no'"),
    ({"memory": {}}, TypeError, "memory must be a Memory, got dict"),
    ({"loss": "mse"}, TypeError, "loss must be callable, got 'mse'"),
    ({"fn": 3}, TypeError, "fn must be callable, got 3"),
    ({"seed": "a"}, TypeError, "seed must be an integer, got 'a'"),
    ({"seed": 1.5}, TypeError, "seed must be an integer, got 1.5"),
    ({"restarts": -1}, ValueError, "restarts must be at least 0, got -1"),
    ({"restarts": 1.5}, TypeError, "restarts must be an integer, got 1.5"),
    ({"noise": "a"}, TypeError, "noise must be a number, got 'a'"),
    ({"noise": math.inf}, ValueError, "noise must be finite and at least 0, got inf"),
    ({"tolerance": 2.0}, ValueError, "tolerance must be positive and below 1"),
    ({"tolerance": "fine"}, TypeError, "tolerance must be a number, got 'fine'"),
    ({"pool": 10.5}, TypeError, "pool must be an integer, got 10.5"),
    ({"sigma": 0.0}, ValueError, "sigma must be positive"),
    ({"sigma": None}, TypeError, r"sigma must be a number, or one per parameter \[2\], got None"),
    ({"sigma": "a"}, TypeError, r"sigma must be a number, or one per parameter \[2\], got 'a'"),
    ({"bounds": (1.0, -1.0)}, ValueError, "lower < upper"),
    ({"bounds": (1.0, 2.0)}, ValueError, "x0 must be within the bounds"),
    ({"bounds": ((-1, 1), (0, 9))}, ValueError, TWO_WAYS),
    ({"bounds": ([-1, 1], [0, 9])}, ValueError, TWO_WAYS),
    (
        {"bounds": ([0, 1], [0, 5])},
        ValueError,
        r"lower < upper, got 0.0 and 0.0 at index 0: to hold the "
        r"parameter at 0.0, leave it out of x0, and call fn\(torch.cat\(\[x\[:, :0\], torch.full_like",
    ),
    ({"bounds": ([0, 1], [-1, 5])}, ValueError, r"lower < upper, got 0.0 and -1.0 at index 0$"),
    ({"bounds": np.array([[-1, 1], [0, 9]])}, ValueError, TWO_WAYS),
    ({"bounds": torch.tensor([[-1, 1], [0, 9]])}, ValueError, TWO_WAYS),
    ({"bounds": np.zeros((3, 2))}, ValueError, "a list of 2 pairs, got 3 entries"),
    ({"bounds": "ab"}, TypeError, "bounds must be .lower, upper. or a list of 2 pairs, got 'ab'"),
    ({"bounds": 5}, TypeError, "bounds must be .lower, upper. or a list of 2 pairs, got 5"),
    ({"bounds": ("a", "b")}, TypeError, r"bounds must be numbers, tensors \[n\] or None, got 'a'"),
    ({"checkpoint": 5}, TypeError, "checkpoint must be a path, got 5"),
    (
        {"checkpoint": "/nonexist/a.pt"},
        ValueError,
        "checkpoint must be a file in a folder.*'/nonexist/a.pt'",
    ),
]
RETURNED = [
    (lambda z: z, ValueError, r"fn must return one number per point if there is no loss=, got shape \[3, 2\]"),
    (lambda z: z.sum(), ValueError, "fn must return one value per point"),
    (lambda z: z.sum(1) * math.nan, ValueError, "not finite at the start"),
    (lambda z: "nothing", TypeError, "must return a tensor or a NumPy array"),
]


@pytest.mark.parametrize(("wrong", "error", "message"), REFUSED, ids=[str(list(one[0].items())) for one in REFUSED])
def test_what_is_refused_before_the_first_evaluation(wrong, error, message):
    def fn(z):
        raise AssertionError

    settings = {"fn": fn, "x0": zeros(2), "sigma": 1.0, "seed": 0, **wrong}
    with pytest.raises(error, match=message):
        zh.minimize(settings.pop("fn"), settings.pop("x0"), **settings)


@pytest.mark.parametrize(("fn", "error", "message"), RETURNED)
def test_what_a_function_may_not_return(fn, error, message):
    with pytest.raises(error, match=message):
        zh.minimize(fn, zeros(2), sigma=1.0, seed=0)


@pytest.mark.parametrize("value", [2.5, "a", None])
def test_what_a_search_is_not_asked_for(value):
    search = zh.optim.TrustRegion(zeros(2), sigma=1.0, seed=0)
    with pytest.raises(TypeError, match=f"batch must be an integer, got {value!r}"):
        search.ask(value)
    search.ask()
    if value != 2.5:
        with pytest.raises(TypeError, match=f"values must be a tensor, an array or numbers, got {value!r}"):
            search.tell(value)


def test_a_checkpoint_that_is_none(tmp_path):
    settings = {"sigma": 2.0, "seed": 0, "max_evaluations": 9}
    good = tmp_path / "good.pt"
    zh.minimize(tilted, zeros(2), checkpoint=good, **settings)
    for name, content in (("corrupt", b"example"), ("empty", b""), ("cut", good.read_bytes()[:500])):
        path = tmp_path / name
        path.write_bytes(content)
        with pytest.raises(ValueError, match=f"checkpoint must be a new file, or.*{name}: torch.load cannot read it"):
            zh.minimize(tilted, zeros(2), checkpoint=path, **settings)
        assert path.read_bytes() == content
    torch.save({"noise": 0.0}, tmp_path / "other.pt")
    with pytest.raises(ValueError, match=r"checkpoint must be .*other\.pt: .*this one lacks sure, .*without a version"):
        zh.minimize(tilted, zeros(2), checkpoint=tmp_path / "other.pt", **settings)
    with pytest.raises(ValueError, match=r"good\.pt: x0 must be torch\.float64 as there, got torch\.float32"):
        zh.minimize(tilted, zeros(2, dtype=torch.float32), checkpoint=good, **settings)
    with pytest.raises(ValueError, match=r"good\.pt: state must be of a search with 3 parameters, got one with 2"):
        zh.minimize(tilted, zeros(3), checkpoint=good, **settings)
    with pytest.raises(ValueError, match="checkpoint must be a file in a folder"):
        zh.minimize(tilted, zeros(2), checkpoint=tmp_path, **settings)


def test_a_checkpoint_of_another_start_is_refused(tmp_path):
    settings = {"sigma": 1.0, "checkpoint": tmp_path / "one.pt", "max_evaluations": 20, "seed": 0}
    zh.minimize(tilted, zeros(2), **settings)
    with pytest.raises(ValueError, match=r"one\.pt: x0 must be \[0, 0\] as there, got \[9, 9\]"):
        zh.minimize(tilted, zeros(2) + 9.0, **settings)


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"verbose": "a"}, "verbose must be True or False, got 'a'")],
)
def test_settings_of_a_wrong_type_are_named(settings, message):
    with pytest.raises(TypeError, match=message):
        zh.minimize(tilted, zeros(2), sigma=1.0, **settings)


@pytest.mark.parametrize("engine", ["descent", "gaussian_process"])
def test_a_grid_is_refused_where_no_engine_uses_it(engine):
    message = rf"grid is for the engines 'local' and 'auto', got \(1, 2\) with '{engine}'"
    with pytest.raises(ValueError, match=message):
        zh.minimize(tilted, zeros(2), sigma=1.0, bounds=(-1, 1), engine=engine, grid=(1, 2))


def test_a_pool_is_refused_where_the_engine_keeps_none():
    with pytest.raises(ValueError, match="pool is for the other engines, got 50 with 'local'"):
        zh.minimize(tilted, zeros(2), sigma=1.0, engine="local", pool=50, loss=torch.sum)


def test_points_whose_values_differ_in_shape_are_named():
    def one_or_two(x):
        return torch.ones(1 if x[0] <= 0 else 2)

    with pytest.raises(
        ValueError, match=r"the same shape for every point, got \[2\] at the point \[.*\] and \[1\] before"
    ):
        zh.estimate(one_or_two, zeros(2), zh.Smoothing(sigma=1.0, samples=8, seed=0), vectorized=False)


def test_many_parameters_are_no_number_in_the_text():
    found = zh.minimize(lambda z: z.square().sum(1), zeros(10) + 1.0, sigma=1.0, max_evaluations=30, seed=0)
    assert repr(found).startswith("Minimum(x of shape [10], value=")


@pytest.mark.parametrize("door", [zh.minimize, zh.optim.TrustRegion, zh.optim.Descent, zh.optim.LocalGaussNewton])
def test_signatures_name_types_and_do_not_spell_them_out(door):
    """`help` begins with the signature. The types can still be found by their names."""
    said = str(inspect.signature(door))
    assert "Bounds" in said
    assert "Array" not in said
    hints = typing.get_type_hints(door if door is zh.minimize else door.__init__)
    assert hints["bounds"] == Bounds | None


@pytest.mark.parametrize("returned", [(2,), (3, 1), (), (0,)])
def test_an_output_of_another_shape_than_before_is_named_with_its_point(returned):
    shapes = itertools.chain([(3,)] * 8, itertools.repeat(returned))
    message = (
        rf"^fn must return values of one shape, got {re.escape(str([*returned]))} at the point \[.+, .+\] and \[3\] "
    )
    with pytest.raises(ValueError, match=message):
        zh.minimize(
            lambda x: torch.ones(next(shapes)) * x.sum(), [0.5, 0.5], sigma=0.3, loss=torch.sum, vectorized=False
        )
