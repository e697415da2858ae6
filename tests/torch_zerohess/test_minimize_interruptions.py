"""What an interruption inside a batch of `minimize` keeps: every value that is known, in the result and in the file."""

import concurrent.futures
import importlib
import math
from dataclasses import dataclass

import pytest
import torch
from black_boxes import part
from searches import raising, tilted, zeros

import torch_zerohess as zh
from torch_zerohess.evaluators import Executor, Inline
from torch_zerohess.evaluators.batch import Batch
from torch_zerohess.evaluators.factory import Each
from torch_zerohess.evaluators.partial_values import finished_values, keep_finished
from torch_zerohess.minimization import running
from torch_zerohess.minimization.noise import reserved
from torch_zerohess.minimization.running import Running
from torch_zerohess.search.protocol.ask_tell import AskTell
from truths import vector

SETTINGS = {"sigma": 2.0, "seed": 0, "vectorized": False, "max_evaluations": 16}


class Point:
    """A function of one point, with noise if any; the given call of it (from 0) raises before it draws."""

    def __init__(self, call=-1, error=KeyboardInterrupt, noise=0.0):
        self.call, self.error, self.noise, self.calls, self.points, self.values = call, error, noise, 0, [], []
        self.generator = torch.Generator().manual_seed(0)

    def __call__(self, x):
        self.calls += 1
        if self.calls - 1 == self.call:
            raise self.error
        draw = torch.randn((), generator=self.generator, dtype=torch.float64)
        self.points.append(x.clone())
        self.values.append(float(tilted(x[None])[0] + self.noise * draw))
        return self.values[-1]


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_every_value_that_is_known_is_kept_and_paid_once(noise, bounds, tmp_path):
    """Wherever it is interrupted, a search goes on to the same bits, also of the measured noise."""
    whole = zh.minimize(Point(noise=noise), zeros(2), bounds=bounds, **SETTINGS)
    for k in range(1, 16, 2 if bounds is None else 5):
        path, memory = tmp_path / f"{k}.pt", zh.Memory()
        f = Point(k, noise=noise)
        part = zh.minimize(f, zeros(2), bounds=bounds, checkpoint=path, memory=memory, **SETTINGS)
        assert (part.status, part.evaluations, part.values.tolist()) == ("interrupted", k, f.values)
        assert torch.equal(memory.points, part.points)
        assert torch.equal(part.points, whole.points[:k])
        assert noise or part.value == min(f.values)
        rest = zh.minimize(f, zeros(2), bounds=bounds, checkpoint=path, memory=memory, **SETTINGS)
        assert f.calls == 1 + whole.evaluations
        assert torch.equal(rest.points, whole.points)
        assert torch.equal(rest.values, whole.values)
        assert torch.equal(memory.points, whole.points)
        assert (rest.value, rest.value_error, rest.message) == (whole.value, whole.value_error, whole.message)
        assert torch.equal(rest.x, whole.x)


@pytest.mark.parametrize("error", [ZeroDivisionError, SystemExit])
def test_an_exception_keeps_them_too(error, tmp_path):
    f = Point(2, error)
    with pytest.raises(error) as caught:
        zh.minimize(f, zeros(2), checkpoint=tmp_path / "search.pt", **SETTINGS)
    found = caught.value.minimum
    assert (found.status, found.evaluations, found.value) == ("failed", 2, min(f.values))
    assert found.gradient is None
    zh.minimize(f, zeros(2), checkpoint=tmp_path / "search.pt", **SETTINGS)
    assert f.calls == 1 + 16


class Pool(Inline):
    """A pool of workers in this process."""

    def __init__(self, workers):
        pass


@pytest.mark.parametrize("fails", [False, True])
@pytest.mark.parametrize(("owner", "what"), [(Pool, "close"), (Running, "write")], ids=["workers", "file"])
def test_ctrl_c_after_the_search_does_not_take_its_result(owner, what, fails, tmp_path, monkeypatch):
    """Nor the error that ended it, and what was interrupted is done again."""
    calls, finish, path = [], getattr(owner, what), tmp_path / "search.pt"

    def interrupted(self):
        calls.append(self)
        if len(calls) == 1:
            raise KeyboardInterrupt
        finish(self)

    monkeypatch.setattr(importlib.import_module("torch_zerohess.minimize"), "ProcessPool", Pool)
    monkeypatch.setattr(owner, what, interrupted)
    settings = {**SETTINGS, "max_evaluations": 8, "checkpoint": path, "workers": 1}
    monkeypatch.setattr(running, "_PAUSE", math.inf)  # no file is written before the end
    try:
        fit = zh.minimize(Point(5 if fails else -1, ZeroDivisionError), zeros(2), **settings)
    except ZeroDivisionError as error:
        fit = error.minimum
    except KeyboardInterrupt:
        pytest.fail("the result is lost")
    assert (fit.status, fit.evaluations) == (("failed", 5) if fails else ("budget", 8))
    assert len(calls) == 2
    assert path.exists()


def tilted_at(x):
    return tilted(x[None])[0]


@dataclass(frozen=True)
class Frozen(Exception):
    """An error that takes no attributes."""

    why: str


def test_nothing_takes_the_place_of_the_own_error():
    """Where no loss is finite, and where the error cannot carry the result of complete batches."""
    with pytest.raises(ValueError, match="not finite at the start x0: nan"):
        zh.minimize(lambda x: torch.full((len(x),), math.nan), zeros(2), sigma=1.0, noise=0.1, seed=0)
    for noise in (None, 0.1):
        fn = raising(lambda x: math.nan, 1, OSError("licence server gone"))
        with pytest.raises(OSError, match="licence server gone") as caught:
            zh.minimize(fn, zeros(2), noise=noise, **SETTINGS)
        found = caught.value.minimum
        assert (found.evaluations, math.isnan(found.value), found.x.tolist()) == (1, True, [0.0, 0.0])
    with pytest.raises(Frozen, match="broken"):
        zh.minimize(raising(tilted_at, 10, Frozen("broken")), zeros(2), **SETTINGS)


def test_a_file_without_values_does_not_bind_a_smaller_budget(tmp_path):
    """Nor does one with outputs whose losses are not known."""
    path, settings = tmp_path / "search.pt", {"sigma": 1.0, "seed": 0, "batch": 50, "vectorized": False}
    with pytest.raises(KeyboardInterrupt):
        zh.minimize(Point(0), zeros(2), checkpoint=path, **settings)
    assert not path.exists()
    assert zh.minimize(Point(), zeros(2), checkpoint=path, max_evaluations=20, **settings).evaluations == 20
    path.unlink()
    settings |= {"loss": lambda y: 1 / 0, "checkpoint": path}
    with pytest.raises(KeyboardInterrupt):
        zh.minimize(raising(lambda x: x, 4, KeyboardInterrupt), zeros(2), **settings)
    fit = zh.minimize(lambda x: x, zeros(2), max_evaluations=20, **settings)
    assert (fit.status, fit.evaluations, len(fit.points), math.isnan(fit.value)) == ("budget", 0, 0, True)


def test_measured_noise_is_paid_once_if_the_first_model_is_interrupted(tmp_path, monkeypatch):
    settings = {**SETTINGS, "bounds": (-5.0, 5.0), "checkpoint": tmp_path / "search.pt"}
    f = Point(noise=0.3)
    with monkeypatch.context() as patch:
        interrupted = raising(None, 0, KeyboardInterrupt)
        patch.setattr(AskTell, "tell", lambda search, values: interrupted(values))
        part = zh.minimize(f, zeros(2), **settings)
    assert (part.status, part.evaluations) == ("interrupted", f.calls)
    fit = zh.minimize(f, zeros(2), **settings)
    assert fit.evaluations == f.calls == 16
    assert fit.values.tolist() == f.values
    whole = zh.minimize(Point(noise=0.3), zeros(2), **{**settings, "checkpoint": None})
    assert torch.equal(fit.values, whole.values)


@pytest.mark.parametrize("of", ["search", "decision"])
def test_a_batch_that_is_interrupted_with_gaps_is_paid_once(of, tmp_path):
    """Workers finish in any order: of the second batch, or the first one of the decision, two values are known."""
    before = 8 if of == "search" else 128 - reserved(128)
    settings = {**SETTINGS, "batch": 8, "noise": 0.3, "max_evaluations": 128, "checkpoint": tmp_path / "search.pt"}
    f, asked = Point(noise=0.3), []

    def with_gaps(fn, points):
        if len(asked) or f.calls < before:
            return fn(points)
        asked.append(points)
        error, numbers = KeyboardInterrupt(), [1, 3]
        keep_finished(error, points, dict(zip(numbers, fn(points[numbers]), strict=True)))
        raise error

    part = zh.minimize(f, zeros(2), evaluator=with_gaps, **settings)
    assert part.status == "interrupted"
    assert len(asked[0]) > 3
    fit = zh.minimize(f, zeros(2), evaluator=with_gaps, **settings)
    assert fit.evaluations == f.calls == 128
    if of == "decision":  # the gaps of a search are filled
        assert torch.equal(fit.points[: part.evaluations], part.points)
    # Every value is beside its own point, whatever the order in which they came.
    came = {value: point.tolist() for point, value in zip(f.points, f.values, strict=True)}
    assert {value: point for point, value in zip(fit.points.tolist(), fit.values.tolist(), strict=True)} == came


def test_outputs_are_kept_where_the_loss_raises(tmp_path):
    """Their losses are not known: the file has them, the result has not."""
    calls = []

    def output(x):
        calls.append(x)
        return torch.stack([x.sum() - 1.0, x.prod(), x[0]])

    for call in (0, 8):  # in the first step, and in a later one
        calls.clear()
        settings = {**SETTINGS, "checkpoint": tmp_path / f"{call}.pt", "max_evaluations": 15}
        with pytest.raises(ZeroDivisionError) as caught:
            zh.minimize(output, zeros(2), loss=raising(lambda y: y.square().sum(), call), **settings)
        assert hasattr(caught.value, "minimum") == (call > 0)
        fit = zh.minimize(output, zeros(2), loss=lambda y: y.square().sum(), **settings)
        assert len(calls) == fit.evaluations == 15


def test_an_interrupted_batch_that_is_larger_than_what_is_left(tmp_path):
    f, path = Point(4), tmp_path / "search.pt"
    zh.minimize(f, zeros(2), batch=8, checkpoint=path, **SETTINGS)
    fit = zh.minimize(f, zeros(2), batch=8, checkpoint=path, **{**SETTINGS, "max_evaluations": 5})
    assert (fit.status, fit.evaluations, f.calls) == ("budget", 4, 5)
    assert fit.message.startswith("max_evaluations (5) allows no step after the 4 so far")


def test_evaluators_keep_them_by_number():
    """A pool of threads, and what a pool of processes knows of a call."""

    def fn(z):
        if float(z[0, 0]) == 2.0:
            raise ZeroDivisionError
        return z.sum(1)

    points = torch.arange(4.0)[:, None]
    with concurrent.futures.ThreadPoolExecutor(1) as threads:
        with pytest.raises(ZeroDivisionError) as caught:
            Executor(threads)(fn, points)
        numbers, values = finished_values(caught.value, points)
    assert numbers[:2] == [0, 1]
    assert values.tolist() == [float(k) for k in numbers]
    batch = Batch(points, 0, most=2)
    batch.came(batch.take(), part(vector(0.0, 1.0)))
    assert {k: float(one) for k, one in batch.known.items()} == {0: 0.0, 1: 1.0}


def test_only_the_values_of_the_own_call_are_taken():
    """A black box may make calls itself, whose exceptions carry their values."""
    points, error = torch.zeros(3, 2), ZeroDivisionError()
    keep_finished(error, points, {1: torch.tensor(2.0), 0: torch.tensor(1.0)})
    numbers, values = finished_values(error, points)
    assert (numbers, values.tolist()) == ([0, 1], [1.0, 2.0])
    assert finished_values(error, points.clone())[0] == []
    keep_finished(error, points, {0: torch.zeros(2), 1: torch.zeros(3)})
    assert finished_values(error, points)[0] == []
    assert finished_values(ValueError(), points)[0] == []


def test_a_function_may_return_one_buffer_for_every_point():
    buffer = torch.zeros(2)

    def fn(x):
        buffer.copy_(x)
        return buffer

    points = torch.arange(6.0).view(3, 2)
    assert torch.equal(Each(fn)(points), points)
