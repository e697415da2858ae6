"""Calls that do not wait for each other: the bits of calls that do, in whichever order they are asked for."""

import concurrent.futures
import threading

import black_boxes
import pytest
import torch
from black_boxes import points

import torch_zerohess as zh
from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.evaluators import Executor, Inline, ProcessPool
from truths import vector


@pytest.fixture(scope="module")
def threads():
    with concurrent.futures.ThreadPoolExecutor(2) as executor:
        yield Executor(executor)


@pytest.fixture(scope="module")
def one_thread():
    with concurrent.futures.ThreadPoolExecutor(1) as executor:
        yield Executor(executor)


@pytest.fixture(params=["pool", "threads", "inline"])
def evaluator(request):
    return Inline() if request.param == "inline" else request.getfixturevalue(request.param)


def test_the_bits_of_calls_that_wait(evaluator):
    """Batches of several sizes, and of two black boxes, in the reverse order and with what the caller overwrites."""
    batches = [points(count) for count in (3, 1, 17, 2, 40)]
    fns = [black_boxes.waves, black_boxes.waves, black_boxes.picture, black_boxes.waves, black_boxes.picture]
    expected = [fn(z) for fn, z in zip(fns, batches, strict=True)]
    given = [z.clone() for z in batches]
    futures = [evaluator.submit(fn, z) for fn, z in zip(fns, given, strict=True)]
    for z in given:
        z.zero_()
    for future, values in reversed(list(zip(futures, expected, strict=True))):
        assert isinstance(future, concurrent.futures.Future)
        assert torch.equal(future.result(), values)
        assert future.lost == {}
    aux = points(4, 2)
    assert torch.equal(evaluator.submit(black_boxes.waves, points(4), aux).result(), expected_with(aux))
    assert evaluator.submit(black_boxes.waves, points(0)).result().shape == (0,)


def expected_with(aux):
    return black_boxes.waves(points(len(aux)), aux)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_two_results_of_a_batch_are_no_points(evaluator, count):
    message = r"^fn must return one tensor \[K, \*out\], got a tuple of 2: return one"
    future = evaluator.submit(black_boxes.with_numbers, points(count))
    with pytest.raises(TypeError, match=message):
        future.result()
    with pytest.raises(TypeError, match=message):
        BlackBoxCall(black_boxes.with_numbers, evaluator=evaluator)(points(count), [])


def test_an_evaluator_in_this_process_has_nothing_to_close():
    with Inline() as evaluator:
        assert repr(evaluator) == "Inline()"
    assert torch.equal(evaluator(black_boxes.waves, points(2)), black_boxes.waves(points(2)))


def test_an_evaluator_in_this_process_records_nothing():
    recording = []

    def fn(z):
        recording.append(torch.is_grad_enabled())
        return z.sum(1)

    z = points(2).requires_grad_()
    assert not Inline()(fn, z).requires_grad
    with torch.no_grad():
        Inline()(fn, z)
        assert not torch.is_grad_enabled()
    assert torch.is_grad_enabled()
    assert recording == [False, False]


@pytest.mark.parametrize("name", ["pool", "one_thread", "inline"])
def test_a_black_box_may_use_its_arrays_again(name, request):
    """One that returns the same buffer every time, and writes to its points."""
    evaluator = Inline() if name == "inline" else request.getfixturevalue(name)
    fn, given, aux = black_boxes.Reusing(3), [torch.full((3, 2), float(k)) for k in range(3)], torch.ones(3)
    futures = [evaluator.submit(fn, z, aux) for z in given]
    for k, future in enumerate(futures):
        assert torch.equal(future.result(), torch.full((3,), 2.0 * k + 1.0))
        assert torch.equal(given[k], torch.full((3, 2), float(k)))
    assert torch.equal(aux, torch.ones(3))


def test_an_error_is_that_of_its_own_call(evaluator):
    first = evaluator.submit(black_boxes.waves, points(5))
    wrong = evaluator.submit(black_boxes.failing, torch.tensor([[0.1], [0.7], [0.9]]))
    left = evaluator.submit(black_boxes.leaving, points(1))
    last = evaluator.submit(black_boxes.waves, points(6))
    assert isinstance(left.exception(60), SystemExit)
    assert isinstance(wrong.exception(), ArithmeticError)
    assert torch.equal(first.result(), black_boxes.waves(points(5)))
    assert torch.equal(last.result(), black_boxes.waves(points(6)))


def interrupted(z):
    raise KeyboardInterrupt


def test_ctrl_c_is_raised_where_the_black_box_is_called():
    with pytest.raises(KeyboardInterrupt):
        Inline().submit(interrupted, points(1))


@pytest.mark.parametrize("name", ["pool", "threads"])
def test_points_of_several_calls_are_evaluated_at_the_same_time(name, request, tmp_path):
    fn = black_boxes.Meeting(tmp_path, 2)
    futures = [request.getfixturevalue(name).submit(fn, torch.full((1, 1), float(k))) for k in range(2)]
    for k, future in enumerate(futures):
        assert torch.equal(future.result(), black_boxes.waves(torch.full((1, 1), float(k))))


def test_a_call_that_waits_and_calls_of_several_threads_share_the_workers(pool, tmp_path):
    fn, values = black_boxes.Meeting(tmp_path, 2), {}
    each = [
        threading.Thread(target=lambda k=k: values.update({k: pool(fn, torch.full((1, 1), k))})) for k in (0.0, 1.0)
    ]
    for one in each:
        one.start()
    for one in each:
        one.join()
    assert values == {k: black_boxes.waves(torch.full((1, 1), k)) for k in (0.0, 1.0)}
    smoothing = zh.Smoothing(sigma=0.3, samples=4, seed=0)
    estimate = zh.estimate(black_boxes.waves, vector(0.3, 0.7), smoothing, evaluator=pool)
    assert torch.equal(estimate.gradient, zh.estimate(black_boxes.waves, vector(0.3, 0.7), smoothing).gradient)


def test_a_lost_point_is_that_of_its_own_call(pool):
    fine, lost = (pool.submit(black_boxes.aborting, torch.tensor([[0.1], [one]])) for one in (0.2, 0.7))
    assert lost.result().isnan().tolist() == [False, True]
    assert lost.lost == {1: "the black box ended its process (SIGABRT)"}
    assert (fine.result().isnan().any(), fine.lost) == (False, {})
    assert pool(black_boxes.waves, points(2)).isfinite().all()
    assert pool.lost == {}


@pytest.mark.usefixtures("quick_workers")
def test_a_call_that_has_not_begun_can_be_cancelled_and_a_pool_that_is_closed_says_so(tmp_path):
    with ProcessPool(1) as pool:
        running = pool.submit(black_boxes.Meeting(tmp_path, 2), torch.zeros(1, 1))
        queued, third = (pool.submit(black_boxes.waves, points(2)) for _ in range(2))
        while not list(tmp_path.iterdir()):
            threading.Event().wait(0.01)
        assert queued.cancel()
        assert not running.cancel()
        (tmp_path / "1").touch()
        assert set(concurrent.futures.as_completed([queued, third], 60)) == {queued, third}
        assert torch.equal(third.result(), black_boxes.waves(points(2)))
        waiting = pool.submit(black_boxes.Meeting(tmp_path, 9), torch.zeros(1, 1))
        within = pool.submit(black_boxes.waves, points(1))
        while not waiting.running():
            threading.Event().wait(0.01)
    assert within.cancelled()
    with pytest.raises(RuntimeError, match="closed before the values were there"):
        waiting.result()
    with pytest.raises(RuntimeError, match="the ProcessPool is closed"):
        pool.submit(black_boxes.waves, points(1))


def test_a_callback_may_submit_but_not_wait(pool, tmp_path):
    found = concurrent.futures.Future()

    def again(_):
        try:
            pool(black_boxes.waves, points(1))
        except RuntimeError as error:
            found.set_result((str(error), pool.submit(black_boxes.waves, points(1))))

    pool.submit(black_boxes.Meeting(tmp_path, 2), torch.zeros(1, 1)).add_done_callback(again)
    (tmp_path / "1").touch()
    message, future = found.result(60)
    assert "may submit to the ProcessPool, but not wait" in message
    assert torch.equal(future.result(), black_boxes.waves(points(1)))
