"""Executors of others: the same bits, one error, one making of the black box per process."""

import concurrent.futures
import copy
import multiprocessing
import threading
import warnings

import black_boxes
import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.evaluators import Executor, Factory
from truths import vector

Z = torch.rand(40, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


@pytest.fixture(scope="module")
def threads():
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        yield executor


def standard():
    return concurrent.futures.ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn"))


def loky():
    import loky

    return loky.ProcessPoolExecutor(1)


class Processes(dict):
    """An executor of each kind, with one process, which takes seconds to start."""

    def __missing__(self, make):
        self[make] = make()
        return self[make]


@pytest.fixture(scope="module")
def processes():
    made = Processes()
    yield made
    for one in made.values():
        one.shutdown()


@pytest.mark.parametrize("make", [standard, loky])
def test_an_error_that_cannot_be_read_is_named_and_breaks_no_pool(make, processes):
    evaluator = Executor(processes[make])
    for _ in range(2):
        with pytest.raises(RuntimeError, match=r"^Odd: a$") as raised:
            evaluator(black_boxes.odd, Z)
        assert "in odd" in str(raised.value.__cause__)
        assert torch.equal(evaluator(black_boxes.waves, Z), black_boxes.waves(Z))
    with pytest.raises(SystemExit, match="done"):
        evaluator(black_boxes.leaving, Z)


def test_a_thread_raises_the_error_itself(threads):
    with pytest.raises(black_boxes.Odd):
        Executor(threads)(black_boxes.odd, Z)


def test_workers_have_the_default_type_of_the_caller(processes):
    before = torch.get_default_dtype()
    try:
        for dtype in (torch.float64, torch.float32):
            torch.set_default_dtype(dtype)
            assert Executor(processes[standard])(black_boxes.in_default_type, Z).dtype == dtype
    finally:
        torch.set_default_dtype(before)


def test_a_process_keeps_several_black_boxes(tmp_path, processes):
    boxes = [Factory(black_boxes.Counted, tmp_path / "made") for _ in range(5)]
    evaluator = Executor(processes[standard])
    for k in (0, 1, 2, 0, 3, 4, 0, 2, 0):  # the fifth takes the place of the second
        assert torch.equal(evaluator(boxes[k], Z), black_boxes.waves(Z))
    assert len((tmp_path / "made").read_text().split()) == 5
    evaluator(boxes[1], Z)
    assert len((tmp_path / "made").read_text().split()) == 6


def test_dask():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # dask's own
        from distributed import Client

        with Client(processes=False, n_workers=2, threads_per_worker=1, dashboard_address=None) as client:
            evaluator = Executor(client.get_executor())
            assert torch.equal(evaluator(black_boxes.waves, Z), black_boxes.waves(Z))
            with pytest.raises(ArithmeticError, match="no value above one half"):
                evaluator(black_boxes.failing, Z)
            with pytest.raises(black_boxes.Odd):
                evaluator(black_boxes.odd, Z)
            with pytest.raises(SystemExit, match="done"):
                evaluator.submit(black_boxes.leaving, Z).result(60)
            noise = torch.cat([evaluator(black_boxes.noisy, torch.zeros(4, 1)) for _ in range(2)])
            assert len(noise.unique()) == 8  # equal arguments are no reason to take an earlier value


def test_threads_serve_a_layer_and_any_function(threads):
    x, smoothing = vector(0.3, 0.7), zh.Smoothing(sigma=0.3, samples=8, seed=0)
    slopes = [
        torch.func.grad(zh.smooth(lambda z: (z**3).sum(1), smoothing, evaluator=one))(x)
        for one in (None, Executor(threads))
    ]
    assert torch.equal(*slopes)


def test_a_copy_of_a_layer_uses_the_same_executor(threads):
    layer = zh.BlackBox(lambda z: (z**3).sum(1), zh.Smoothing(sigma=0.3, samples=8), evaluator=Executor(threads))
    other = copy.deepcopy(layer)
    assert other.call.evaluator is not layer.call.evaluator
    assert other.call.evaluator.executor is threads
    x = vector(0.3, 0.7)
    assert torch.equal(other(x), layer(x))


def test_the_error_is_that_of_the_first_point(threads):
    z = torch.tensor([[0.1], [0.7], [0.9]])
    with Executor(threads) as evaluator:
        for _ in range(5):
            with pytest.raises(ArithmeticError, match=r"got 0\.700"):
                evaluator(black_boxes.failing, z)
    with pytest.raises(RuntimeError, match="the Executor is closed"):
        evaluator(black_boxes.waves, z)
    assert threads.submit(int).result() == 0  # the executor is the caller's


class Interrupted:
    """An executor of this process. Before its next task another thread does something."""

    def __init__(self):
        self.other = None

    def submit(self, function, *arguments):
        other, self.other = self.other, None
        if other:
            thread = threading.Thread(target=other)
            thread.start()
            thread.join()
        future = concurrent.futures.Future()
        future.set_result(function(*arguments))
        return future


def test_threads_that_share_it_get_the_values_of_their_own_black_box():
    executor, others = Interrupted(), []
    evaluator = Executor(executor)
    executor.other = lambda: others.append(evaluator(torch.Tensor.exp, Z))
    assert torch.equal(evaluator(black_boxes.waves, Z), black_boxes.waves(Z))
    assert torch.equal(others[0], Z.exp())


def test_what_is_no_executor_is_refused():
    with pytest.raises(TypeError, match="executor must have a method submit"):
        Executor(3)


def test_a_function_of_a_script_has_the_global_variables_of_each_call(processes):
    names = {"__name__": "__main__", "factor": 1.0}
    exec("def scaled(z): return factor * z.sum(1)", names)
    evaluator = Executor(processes[loky])
    for names["factor"] in (1.0, 10.0):
        assert torch.equal(evaluator(names["scaled"], Z), names["factor"] * Z.sum(1))


def test_a_black_box_that_has_changed_is_sent_again(processes):
    evaluator, fn = Executor(processes[standard]), black_boxes.Scaled()
    assert torch.equal(evaluator(fn, Z), Z.sum(1))
    fn.factor = 10.0
    assert torch.equal(evaluator(fn, Z), 10.0 * Z.sum(1))


@pytest.mark.parametrize("make", [standard, loky])
def test_pools_of_processes(make, processes, tmp_path):
    """At the end they are broken, so this is the last test."""
    with processes[make] as pool:
        del processes[make]
        evaluator = Executor(pool)
        fn = Factory(black_boxes.Counted, tmp_path / "made")
        for _ in range(2):
            assert torch.equal(evaluator(fn, Z), black_boxes.waves(Z))
        assert len((tmp_path / "made").read_text().split()) == 1
        with pytest.raises(ArithmeticError, match="no value above one half"):
            evaluator(black_boxes.failing, Z)
        with pytest.raises(concurrent.futures.BrokenExecutor):
            evaluator(black_boxes.never, Z)
