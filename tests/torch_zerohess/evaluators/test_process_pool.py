"""Worker processes: the same bits as in this process, and what becomes of black boxes that crash, hang or raise.

A worker takes seconds to start, so most are forked (`quick_workers`), and tests share one pool where they can.
"""

import functools
import gc
import math
import multiprocessing
import os
import pickle
import signal
import subprocess
import sys
import threading
import time

import black_boxes
import pytest
import torch
from black_boxes import part, points
from endings import alive, ends

import torch_zerohess as zh
from torch_zerohess.evaluators import Factory, Inline, LostEvaluationError, ProcessPool
from torch_zerohess.evaluators.batch import MOST, Batch, cut
from torch_zerohess.evaluators.lifetime import ending
from torch_zerohess.evaluators.partial_values import finished_values
from torch_zerohess.evaluators.process_pool import cores
from truths import Exponential, PlaneWave, deviation, vector

S = zh.Smoothing(sigma=0.3, samples=8, seed=0)


def pids(pool: ProcessPool) -> set[int]:
    return {int(one) for one in pool(black_boxes.process, points(2 * MOST))}


def test_values_have_the_bits_of_this_process(pool):
    for count in (1, 2, 17, MOST + 3):
        z = points(count)
        assert torch.equal(pool(black_boxes.waves, z), black_boxes.waves(z))
        assert torch.equal(pool(black_boxes.waves, z.float()), black_boxes.waves(z.float()))
    z, aux = points(5), (points(5, 2), torch.ones(5, 1))
    assert torch.equal(pool(black_boxes.waves, z, *aux), black_boxes.waves(z, *aux))


def test_large_values_and_points_go_through_shared_memory(pool):
    z = points(3)
    assert torch.equal(pool(black_boxes.picture, z), black_boxes.picture(z))
    assert any(one.messages.memory is not None for one in pool._staffed)
    wide = points(3, 20_000)
    assert torch.equal(pool(black_boxes.waves, wide), black_boxes.waves(wide))


@pytest.mark.parametrize(
    "values",
    [
        torch.arange(6.0).reshape(2, 3).T,
        torch.tensor([1.0]).expand(3),
        torch.tensor([1 + 2j, 3 - 4j]).conj(),
        torch.tensor([1 + 2j, 3 - 4j]).conj().imag,  # its bytes have the other sign
        torch.tensor([True, False]),
        torch.tensor([1.5, math.nan], dtype=torch.bfloat16),
        torch.zeros(2, 0),
        torch.arange(10)[3::2],
        torch.ones(2, requires_grad=True),
    ],
)
def test_tensors_of_any_kind_arrive_as_they_were(values):
    found = part(values)
    torch.testing.assert_close(found.tensor(), values.detach(), rtol=0, atol=0, equal_nan=True)
    for rows in (slice(0, 1), slice(1, 9)):
        one = found.rows(rows.start, rows.stop).tensor()
        torch.testing.assert_close(one, values.detach()[rows], rtol=0, atol=0, equal_nan=True)


def test_chunks_with_values_of_two_types_have_the_wider_one():
    batch = Batch(torch.zeros(2, 1), retries=0)
    for dtype in (torch.float32, torch.float64):
        batch.came(batch.take(), part(torch.ones(1, 3, dtype=dtype)))
    assert torch.equal(batch.result(), torch.ones(2, 3, dtype=torch.float64))


def test_workers_are_other_processes(pool):
    found = pids(pool)
    assert 1 <= len(found) <= 2
    assert os.getpid() not in found


def test_the_black_box_may_take_single_points_or_none(pool):
    call = zh.estimate(black_boxes.of_one, vector(0.3, 0.7), S, vectorized=False, evaluator=pool)
    assert torch.equal(call.gradient, zh.estimate(black_boxes.of_one, vector(0.3, 0.7), S, vectorized=False).gradient)
    assert pool(black_boxes.waves, points(0)).shape == (0,)


def test_every_door_takes_the_pool(pool):
    x = vector(0.3, 0.7)
    here, there = (zh.estimate(black_boxes.waves, x, S, evaluator=one) for one in (None, pool))
    assert torch.equal(here.gradient, there.gradient)
    assert torch.equal(here.hessian(), there.hessian())
    for door in (zh.BlackBox, zh.smooth):
        slopes = [torch.func.grad(door(black_boxes.waves, S, evaluator=one))(x) for one in (None, pool)]
        assert torch.equal(*slopes)
    settings = {"sigma": 0.5, "bounds": (-1, 1), "seed": 0, "max_evaluations": 12}
    before = multiprocessing.active_children()
    doors = {"evaluator": None}, {"evaluator": pool}, {"workers": 1}
    fits = [zh.minimize(black_boxes.waves, x, **door, **settings) for door in doors]
    for fit in fits[1:]:
        assert torch.equal(fits[0].x, fit.x)
        assert [one.value for one in fits[0].history] == [one.value for one in fit.history]
    assert set(multiprocessing.active_children()) <= set(before)


def test_a_factory_is_called_once_in_every_worker(pool, tmp_path):
    fn = Factory(black_boxes.Counted, tmp_path / "made")
    for _ in range(3):
        z = points(40)
        assert torch.equal(pool(fn, z), black_boxes.waves(z))
    made = (tmp_path / "made").read_text().split()
    assert len(made) == len(set(made)) <= 2
    assert str(os.getpid()) not in made
    assert torch.equal(Inline()(fn, z), black_boxes.waves(z))
    assert torch.equal(Inline()(fn, z), black_boxes.waves(z))
    assert (tmp_path / "made").read_text().split() == [*made, str(os.getpid())]


@pytest.mark.usefixtures("quick_workers")
@pytest.mark.parametrize(("limit", "count"), [(None, 5), (10**12, 9)])
def test_a_worker_keeps_the_black_boxes_that_were_used_last(tmp_path, limit, count):
    boxes = [Factory(black_boxes.Counted, tmp_path / "made") for _ in range(5)]
    z = points(3)
    limited = {} if limit is None else {"memory_limit": limit}
    with ProcessPool(1, **(limited if sys.platform == "linux" else {})) as pool:
        for k in (0, 1, 2, 0, 3, 4, 0, 2, 0):  # the fifth takes the place of the second
            assert torch.equal(pool(boxes[k], z), black_boxes.waves(z))
        with pytest.raises(OSError, match="the scene is not there"):
            pool(Factory(black_boxes.broken), z)
        assert torch.equal(pool(boxes[0], z), black_boxes.waves(z))
    made = len((tmp_path / "made").read_text().split())
    assert made == (count if limited else 5) + (limit is not None)


def test_workers_have_the_default_type_of_the_caller(pool):
    before = torch.get_default_dtype()
    try:
        for dtype in (torch.float64, torch.float32):
            torch.set_default_dtype(dtype)
            assert pool(black_boxes.in_default_type, points(3)).dtype == dtype
    finally:
        torch.set_default_dtype(before)


def test_a_black_box_is_made_with_gradients_and_called_without(pool):
    for _ in range(2):
        assert pool(Factory(black_boxes.sloped), points(5)).tolist() == [0.0] * 5


def test_an_error_comes_with_the_traceback_of_the_worker(pool):
    z = torch.tensor([[0.1], [0.2], [0.7], [0.1], [0.9]])
    with pytest.raises(ArithmeticError, match=r"got 0\.700") as raised:  # the first point's, whoever is faster
        pool(black_boxes.failing, z)
    assert "black_boxes.py" in str(raised.value.__cause__)
    assert "in failing" in str(raised.value.__cause__)
    numbers, values = finished_values(raised.value, z)
    assert numbers[:2] == [0, 1]
    assert torch.equal(values, z[numbers, 0])
    with pytest.raises(RuntimeError, match=r"^Odd: a$"):
        pool(black_boxes.odd, z)
    with pytest.raises(SystemExit, match="done"):
        pool(black_boxes.leaving, z)
    with pytest.raises(OSError, match="the scene is not there"):
        pool(Factory(black_boxes.broken), z)
    assert torch.equal(pool(black_boxes.waves, z), black_boxes.waves(z))  # the other worker's same error is no news


def test_a_process_that_the_black_box_forks_does_not_answer(pool):
    z = torch.tensor([[0.1], [0.7], [0.2], [0.9]])
    for _ in range(2):
        assert torch.equal(pool(black_boxes.forking, z), z[:, 0])


def test_the_black_box_may_have_processes_of_its_own(pool):
    z = points(1)  # for one worker: a process takes seconds to start there
    assert torch.equal(pool(black_boxes.with_processes, z), z.sum(1))


def collated(evaluator, rows):
    return evaluator(black_boxes.waves, torch.stack(rows))


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_worker_of_a_data_loader_is_told_that_it_cannot_have_workers(monkeypatch):
    monkeypatch.setattr("torch.utils.data._utils.MP_STATUS_CHECK_INTERVAL", 0.2)  # the loader waits so long for its end
    with ProcessPool(1) as pool:
        loader = torch.utils.data.DataLoader(points(3), num_workers=1, collate_fn=functools.partial(collated, pool))
        with pytest.raises(RuntimeError, match=r"such as a worker of a DataLoader: leave evaluator=None there"):
            next(iter(loader))
    gc.collect()  # the error holds the iterator, which waits here


def test_values_of_different_shapes_are_refused(pool):
    with pytest.raises(ValueError, match=r"one shape, got \[3\] for point 0 and \[2\] for point 1, \[0.7\]"):
        pool(black_boxes.ragged, torch.tensor([[0.1], [0.7]]))
    with pytest.raises(TypeError, match=r"real numbers, got torch\.complex64"):
        pool(torch.fft.fft, torch.zeros(1, 2))


def test_what_cannot_be_pickled_is_named(pool):
    z, lock = points(1), threading.Lock()
    for fn, named in [
        (Factory(lambda: black_boxes.waves), "make must be picklable .*<lambda>"),
        (Factory(black_boxes.Disturbed, lock), r"args\[0\] of Factory must be picklable .*lock"),
        (Factory(black_boxes.Disturbed, folder={"a": [lock]}), r"argument 'folder' of Factory\['a'\]\[0\] must"),
        (lambda z: z, "fn must be picklable .*<lambda>"),
        (black_boxes.Disturbed(lock), r"fn\.folder must be picklable"),
    ]:
        with pytest.raises(TypeError, match=named):
            pool(fn, z)


@pytest.mark.parametrize(
    ("file", "what"),
    [
        ("script.py", "put the main part of the script under `if"),
        ("<stdin>", "in no file, .*: write it into one, its main"),
    ],
)
def test_a_main_program_that_workers_cannot_import(file, what, tmp_path, monkeypatch, capfd):
    (tmp_path / "script.py").write_text("raise SystemExit(1)")
    monkeypatch.setattr(sys.modules["__main__"], "__file__", str(tmp_path / file), raising=False)
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", None)
    with ProcessPool(1) as alone, pytest.raises(RuntimeError, match=f"exit code 1 at its start, .*{what}"):
        alone(black_boxes.waves, points(1))


def test_a_function_that_workers_do_not_have_in_their_main_program(pool, monkeypatch):
    def only_here(z):
        return z.sum(1)

    only_here.__module__, only_here.__qualname__ = "__main__", "only_here"
    monkeypatch.setattr(sys.modules["__main__"], "only_here", only_here, raising=False)
    with pytest.raises(RuntimeError, match=r"fn could not be loaded .*only_here.*: put it into a module") as raised:
        zh.estimate(only_here, vector(0.1, 0.2), S, evaluator=pool)
    assert not hasattr(raised.value, "__notes__")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
def test_an_error_of_the_first_batch_in_a_worker_has_a_note(pool):
    with pytest.raises(ValueError, match="only one element tensors") as raised:
        zh.estimate(black_boxes.of_one, vector(0.1, 0.2), S, evaluator=pool)
    assert "if it takes one point, pass vectorized=False" in raised.value.__notes__[0]


def test_an_error_of_values_in_a_worker_has_no_note(pool):
    with pytest.raises(TypeError, match="got a tuple of 2") as raised:
        zh.estimate(black_boxes.with_numbers, vector(0.1, 0.2), S, evaluator=pool)
    assert not hasattr(raised.value, "__notes__")


def test_points_that_end_the_process_are_lost_and_only_they(pool):
    z = torch.tensor([[0.1, 0.2], [0.7, 0.0], [0.3, 0.4]])
    values = pool(black_boxes.aborting, z)
    assert values.isnan().tolist() == [False, True, False]
    assert torch.equal(values[[0, 2]], (z**2).sum(1)[[0, 2]])
    assert pool.lost == {1: "the black box ended its process (SIGABRT)"}
    layer = zh.BlackBox(black_boxes.aborting, S.replace(samples=1), evaluator=pool)
    with pytest.raises(LostEvaluationError, match=r"ended its process \(SIGABRT\), at the point \[0\.9, 0\], number 0"):
        layer(vector(0.9, 0.0))


def test_no_value_at_all_needs_a_known_shape(pool):
    with pytest.raises(LostEvaluationError, match="SIGABRT"):
        pool(black_boxes.never, torch.zeros(1, 2))
    values = pool(black_boxes.aborting, torch.zeros(1, 2))
    assert values.tolist() == [0.0]
    assert pool(black_boxes.aborting, torch.ones(1, 2)).isnan().tolist() == [True]  # the shape is known by now


def test_chunks_are_tried_again_and_then_cut():
    assert [len(one) for one in cut(5)] == [1] * 5
    assert sum(len(one) for one in cut(1000)) == 1000
    assert len(cut(1000)) <= MOST
    batch = Batch(torch.zeros(3, 1), retries=1, most=1)
    for tries in range(2):
        chunk = batch.take()
        assert (chunk.start, chunk.stop, chunk.tries) == (0, 3, tries)
        batch.failed(chunk, "why")
    assert [(one.start, one.stop) for one in batch.waiting] == [(0, 1), (1, 2), (2, 3)]
    batch.came(batch.take(), part(torch.tensor([0.5])))
    for _ in range(2):
        batch.failed(batch.take(), "why")
    assert not batch.finished
    batch.came(batch.take(), part(torch.tensor([2.5])))
    assert batch.finished
    assert batch.lost == {1: "why in each of 2 tries"}
    torch.testing.assert_close(batch.result(), torch.tensor([0.5, math.nan, 2.5]), equal_nan=True)


@pytest.mark.parametrize("retries", [0, 2, 12])
def test_before_the_first_value_every_point_is_tried_before_one_is_tried_again(retries):
    """After more than 9 failures, and more than there are retries, a call without a value is hopeless."""
    most = max(9, retries)
    batch, tried = Batch(torch.zeros(4 if retries else 20, 1), retries), []
    while not batch.hopeless:
        chunk = batch.take()
        tried.append(chunk.start)
        batch.failed(chunk, "why")
    assert tried == [k % len(batch.points) for k in range(most + 1)]
    with pytest.raises(
        LostEvaluationError, match=rf"no value in any of {most + 1} .*: why.*\[0\].*ProcessPool\(retries="
    ):
        batch.result()
    batch.came(batch.take(), part(torch.zeros(1)))
    assert not batch.hopeless


def test_a_slow_point_is_waited_for_before_a_call_is_hopeless():
    batch = Batch(torch.zeros(20, 1), retries=2)
    slow = batch.take()
    for _ in range(15):
        batch.failed(batch.take(), "why")
        assert not batch.hopeless
    batch.failed(slow, "why")
    assert batch.hopeless


@pytest.mark.usefixtures("quick_workers")
def test_a_black_box_that_always_ends_its_process_is_given_up_early(tmp_path, monkeypatch):
    """The search needs 4 values at first, with 3 tries each: 12 evaluations. After 3 it is given up here."""
    monkeypatch.setattr("torch_zerohess.evaluators.batch._FAILURES", 2)
    fn = black_boxes.Dying(tmp_path / "calls")
    message = r"no value in any of [34] .* these 4 .*\(exit code 3\)\. To see why, .*, at \[0, 0\]\. An evaluator with"
    with pytest.raises(LostEvaluationError, match=message):
        zh.minimize(fn, torch.zeros(2), sigma=0.5, workers=2, batch=4)
    assert len(fn.file.read_text().splitlines()) <= 4  # the fourth may be under way


def test_the_first_error_is_raised_whichever_comes_first():
    batch = Batch(torch.zeros(4, 1), retries=0)
    first, second, third, fourth = (batch.take() for _ in range(4))
    batch.raised(second, KeyError("second"))
    batch.failed(third, "no matter")
    assert not batch.finished  # the first may have an error too
    batch.raised(first, KeyError("first"))
    batch.raised(fourth, KeyError("fourth"))
    assert batch.finished
    with pytest.raises(KeyError, match="first"):
        batch.result()


class Losing:
    """An evaluator of this process that has no value where `which`, points [K, n] -> [K], is true."""

    def __init__(self, which):
        self.which = which
        self.lost: dict[int, str] = {}

    def __call__(self, fn, points, *aux):
        values, gone = fn(points, *aux), self.which(points)
        values[gone] = torch.nan
        self.lost = dict.fromkeys(gone.nonzero()[:, 0].tolist(), "it crashed")
        return values


def test_a_point_that_is_lost_is_not_said_to_be_nan():
    lost = {"evaluator": Losing(lambda z: z[:, 0] < 9.0), "on_nonfinite": "drop"}
    with pytest.raises(ValueError, match=r"left 0 of 8 draws.*; it crashed, at the point \["):
        zh.estimate(black_boxes.waves, vector(0.1, 0.2), S, **lost)
    with torch.no_grad(), pytest.raises(ValueError, match=r"it crashed, at the point \[0\.1, 0\.2\], which is x"):
        zh.smooth(black_boxes.waves, S, **lost)(vector(0.1, 0.2))
    second = {"evaluator": Losing(lambda z: torch.arange(len(z)) == 17 + 16), "on_nonfinite": "drop"}
    with pytest.raises(ValueError, match=r"it crashed, at the point \[0\.3, 0\.4\], which is x"):
        zh.estimate(black_boxes.waves, torch.stack([vector(0.1, 0.2), vector(0.3, 0.4)]), S, **second)


def test_a_head_cannot_hide_a_lost_point():
    smoothing = S.replace(samples=4, baseline="mean")
    second = Losing(lambda z: torch.arange(len(z)) == 1)
    settings = {"head": lambda out: out.nan_to_num(3.0), "evaluator": second, "value": "smoothed"}
    assert zh.estimate(black_boxes.waves, vector(0.1, 0.2), smoothing, on_nonfinite="drop", **settings).dropped == 2
    with pytest.raises(LostEvaluationError, match=r"it crashed, at the point \[.*\], number 1 of 8; 1 without a value"):
        zh.estimate(black_boxes.waves, vector(0.1, 0.2), smoothing, **settings)


DROPPING = {"value": "smoothed", "on_nonfinite": "drop"}


def test_every_third_point_ends_its_process_and_the_others_make_the_estimate(pool):
    """Which points these are is a hash of their bits, not of their values."""
    x, smoothing = vector(0.2, -0.3), zh.Smoothing(sigma=0.7, samples=4, seed=9, baseline="mean")
    here, there = (
        zh.estimate(fn, x, smoothing, evaluator=one, **DROPPING)
        for fn, one in (
            (black_boxes.wave_and_growth, Losing(black_boxes.third)),
            (black_boxes.aborting_at_every_third, pool),
        )
    )
    gone = black_boxes.third(there.points).nonzero()[:, 0].tolist()
    assert len(gone) == 2
    assert pool.lost == dict.fromkeys(gone, "the black box ended its process (SIGABRT)")
    assert there.dropped == here.dropped == 2 * len({k % 4 for k in gone})  # with the other ones of their pairs
    for one, other in ((there.value, here.value), (there.gradient, here.gradient), (there.hessian(), here.hessian())):
        assert torch.equal(one, other)


@pytest.mark.filterwarnings("ignore:on_nonfinite='drop' drops most draws")
def test_an_estimate_without_every_third_point_is_unbiased():
    """3 numbers within 5 standard errors: a false alarm in 2e-6 of the seeds."""
    x, smoothing = vector(0.2, -0.3), zh.Smoothing(sigma=0.7, samples=48, baseline="mean")
    parts = PlaneWave(vector(*black_boxes.WAVE)), Exponential(vector(*black_boxes.GROWTH))
    sigma, losing = torch.tensor(0.7), Losing(black_boxes.third)
    truth = torch.cat([sum(one.value(x, sigma) for one in parts)[None], sum(one.gradient(x, sigma) for one in parts)])
    calls = [
        zh.estimate(black_boxes.wave_and_growth, x, smoothing.replace(seed=seed), evaluator=losing, **DROPPING)
        for seed in range(100)
    ]
    assert deviation(torch.stack([torch.cat([call.value[None], call.gradient]) for call in calls]), truth) < 5
    kept = 1 - sum(call.dropped for call in calls) / (100 * 96)
    assert abs(kept - (2 / 3) ** 2) < 0.04  # a pair stays if both of its points do; 5 standard errors


@pytest.mark.usefixtures("quick_workers")
def test_kills_and_hangs_change_no_bit(tmp_path):
    z = points(200)
    fn = black_boxes.Disturbed(tmp_path)
    with ProcessPool(2, timeout=20.0, retries=5) as pool:
        assert torch.equal(pool(fn, z), black_boxes.waves(z))
        pool.timeout = 2.0  # of one evaluation, once the workers are there; a slow one is tried again
        for name in ("kill-0", "hang-0"):
            (tmp_path / name).touch()
        assert torch.equal(pool(fn, z), black_boxes.waves(z))
        assert not list(tmp_path.iterdir())
        assert pool.lost == {}
        children = {one.process.pid for one in pool._staffed}
    assert not [pid for pid in children if alive(pid)]


@pytest.mark.usefixtures("quick_workers")
def test_a_worker_that_takes_too_much_memory_is_replaced_and_one_that_is_old_too():
    with ProcessPool(1, retries=0, recycle=2, memory_limit=10**10) as pool:
        first, second, third = pool(black_boxes.process, points(3)).tolist()
        assert first == second != third
        pool.recycle = None
        pool.memory_limit = pool._staffed[0].bytes_used() + 150_000_000
        with pytest.raises(LostEvaluationError, match=r"took .* bytes, more than memory_limit="):
            pool(black_boxes.hungry, torch.zeros(1, 2))


ORPHANS = """
import os, signal
import torch
import black_boxes
from torch_zerohess.evaluators import ProcessPool
if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # tests in the background of a shell ignore it
    for _ in range(2):
        if not os.fork():  # a parent that need not import torch
            pool = ProcessPool(1)
            worker = int(pool(black_boxes.process, torch.zeros(1, 1, dtype=torch.float64)))
            os.write(1, f"{os.getpid()} {worker}\\n".encode())
            pool(black_boxes.asleep, torch.zeros(1, 1))
    for _ in range(2):
        os.wait()
"""


IMPORTING = """
import multiprocessing, os, signal, sys, threading, time
from pathlib import Path
import torch
import black_boxes
from torch_zerohess.evaluators import ProcessPool

importing, interrupted = (Path(sys.argv[1]) / name for name in ("importing", "interrupted"))

def wait(path):
    while not path.exists():
        time.sleep(0.001)

def interrupt():
    wait(importing)
    os.kill(multiprocessing.active_children()[0].pid, signal.SIGINT)
    interrupted.touch()

if __name__ == "__mp_main__":  # in the worker
    importing.touch()
    wait(interrupted)

if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)
    threading.Thread(target=interrupt).start()
    pool = ProcessPool(1, retries=0)
    print(int(pool(black_boxes.process, torch.ones(1, 2, dtype=torch.float64))))
"""


@pytest.fixture
def environment():
    """Of scripts that import what tests import."""
    return os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


def test_no_worker_outlives_its_parent(tmp_path, environment):
    """Ctrl-C or SIGKILL ends the parent while its worker hangs."""
    script = tmp_path / "script.py"
    script.write_text(ORPHANS)
    program = [sys.executable, str(script)]
    with subprocess.Popen(
        program, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as grandparent:
        lines = [grandparent.stdout.readline() for _ in range(4)]
        assert lines.count("asleep\n") == 2
        families = [map(int, line.split()) for line in lines if line != "asleep\n"]
        for (parent, worker), end in zip(families, (signal.SIGINT, signal.SIGKILL), strict=True):
            os.kill(parent, end)
            assert ends(parent)
            assert ends(worker)
        assert grandparent.wait(60) == 0


def test_ctrl_c_does_not_end_a_worker_that_imports(tmp_path, environment):
    """It ends with the interpreter, and nothing is printed about that."""
    script = tmp_path / "script.py"
    script.write_text(IMPORTING)
    command = [sys.executable, str(script), str(tmp_path)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert done.stderr == ""
    assert ends(int(done.stdout))


def test_arguments_are_checked():
    for wrong, message in [
        ({"workers": 0}, "workers must be at least 1, got 0"),
        ({"timeout": 0}, "timeout must be positive, got 0"),
        ({"retries": -1}, "retries must be at least 0, got -1"),
        ({"recycle": 0}, "recycle must be at least 1, got 0"),
        ({"memory_limit": 0}, "memory_limit must be positive, got 0"),
    ]:
        with pytest.raises(ValueError, match=message):
            ProcessPool(**wrong)
    with pytest.raises(TypeError, match="memory_limit must be a number, got '1e9'"):
        ProcessPool(memory_limit="1e9")
    assert ProcessPool().workers == cores()
    with pytest.raises(TypeError, match="make must be callable"):
        Factory(3)
    with pytest.raises(TypeError, match=r"make must return a black box, which is callable, got 0\.0"):
        Factory(float)(torch.zeros(1, 1))
    with pytest.raises(ValueError, match="give workers or evaluator, not both"):
        zh.minimize(black_boxes.waves, torch.zeros(2), sigma=1.0, workers=2, evaluator=Inline())


def test_a_pool_of_new_processes_with_one_thread_is_closed_for_good_and_copied_by_its_settings():
    with ProcessPool(3, timeout=20.0, retries=4) as pool:
        assert torch.equal(pool(black_boxes.waves, points(1)), black_boxes.waves(points(1)))
        assert len(pool._staffed) == 1  # more workers than points
        assert pool(black_boxes.threads, points(1)).tolist() == [[1.0, 1.0]]
        copy = pickle.loads(pickle.dumps(pool))
        assert (
            repr(copy)
            == repr(pool)
            == "ProcessPool(workers=3, timeout=20.0, retries=4, recycle=None, memory_limit=None)"
        )
    with pytest.raises(RuntimeError, match="the ProcessPool is closed"):
        pool(black_boxes.waves, points(1))
    pool.close()


@pytest.mark.usefixtures("quick_workers")
def test_a_pool_that_is_closed_while_a_worker_makes_its_black_box_prints_nothing(tmp_path, capfd):
    pool = ProcessPool(1)
    call = pool.submit(Factory(black_boxes.made_late, tmp_path / "begun"), points(1))
    while not (tmp_path / "begun").exists():
        time.sleep(0.01)
    pool.close()
    assert call.cancelled()
    captured = capfd.readouterr()
    assert captured.out + captured.err == ""


def test_how_a_process_ended_is_said_in_words():
    assert [ending(code) for code in (0, 3, -signal.SIGSEGV)] == ["exit code 0", "exit code 3", "SIGSEGV"]
    assert ending(-1000) == "signal 1000"
