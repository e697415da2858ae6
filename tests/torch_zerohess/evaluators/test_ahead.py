"""Who serves calls: the thread of a call, the thread of all calls, and nobody after the end. Without processes."""

import concurrent.futures
import gc
import multiprocessing
import threading
import weakref
from types import SimpleNamespace

import black_boxes
import pytest
import torch
from black_boxes import part, points

from torch_zerohess.evaluators import ProcessPool
from torch_zerohess.evaluators.ahead import Ahead
from torch_zerohess.evaluators.batch import Batch
from torch_zerohess.evaluators.job import Function, Job


class Stepping(Ahead):
    """Rounds in this process. Each evaluates one chunk, when the test lets it."""

    def __init__(self):
        self.steps, self.begun, self.ended = threading.Semaphore(0), threading.Event(), False
        self.most = 0
        super().__init__()

    def _sent(self, fn):
        return fn

    def _batch(self, points):
        return Batch(points, 0)

    def _round(self, jobs):
        self.begun.set()
        self.most = max(self.most, len(jobs))
        self.steps.acquire(timeout=5)
        assert not self.ended
        job = next((job for job in jobs if job.waiting), None)
        if job and job.begin():
            chunk = job.batch.take()
            job.batch.came(chunk, part(job.function.fn(job.tensors[0][chunk.start : chunk.stop])))

    def _give_up(self, jobs):
        pass

    def _end(self):
        self.ended = True

    def _wake(self):
        self.steps.release()


@pytest.fixture
def threads():
    with concurrent.futures.ThreadPoolExecutor() as executor:
        yield executor


def under_way(evaluator, threads, z):
    """A call in another thread, in its first round."""
    call = threads.submit(evaluator, black_boxes.waves, z)
    assert evaluator.begun.wait(30)
    return call


def test_submit_does_not_wait_for_the_call_of_another_thread(threads):
    with Stepping() as evaluator:
        call = under_way(evaluator, threads, points(3))
        future = evaluator.submit(black_boxes.waves, points(2))
        assert not call.done()
        evaluator.steps.release(9)
        assert torch.equal(future.result(60), black_boxes.waves(points(2)))
        assert torch.equal(call.result(60), black_boxes.waves(points(3)))
        assert evaluator.most == 2


def test_calls_end_with_the_evaluator(threads):
    evaluator = Stepping()
    call = under_way(evaluator, threads, points(3))
    evaluator.close()
    with pytest.raises(RuntimeError, match="the Stepping was closed before the values were there"):
        call.result(60)
    evaluator = Stepping()
    calls = [under_way(evaluator, threads, points(9)), threads.submit(evaluator, black_boxes.waves, points(9))]
    begun = evaluator.submit(black_boxes.waves, points(9))
    evaluator.close()
    assert begun.cancelled()
    for call in calls:
        with pytest.raises(RuntimeError, match="closed"):
            call.result(60)


def test_a_callback_that_wants_to_end_its_thread_leaves_the_other_calls_alone():
    def leave(_):
        raise SystemExit

    with Stepping() as evaluator:
        evaluator.submit(black_boxes.waves, points(9)).add_done_callback(leave)
        last = evaluator.submit(black_boxes.waves, points(2))
        evaluator.steps.release(11)
        assert torch.equal(last.result(60), black_boxes.waves(points(2)))


def test_a_callback_may_close_the_evaluator():
    evaluator, done = Stepping(), threading.Event()
    evaluator.submit(black_boxes.waves, points(9)).add_done_callback(lambda _: (evaluator.close(), done.set()))
    evaluator.steps.release(9)
    assert done.wait(60)


def test_the_thread_ends_when_nobody_has_the_evaluator():
    """The first future is done before the evaluator goes. The second one is not: it still gets its values."""
    before = set(threading.enumerate())
    for steps in (3, None):
        evaluator = Stepping()
        future, gone = evaluator.submit(black_boxes.waves, points(3)), weakref.ref(evaluator)
        (thread,) = set(threading.enumerate()) - before
        release = evaluator.steps.release
        if steps:
            release(steps)
            future.result(60)
        del evaluator
        if not steps:
            release(3)
        assert torch.equal(future.result(60), black_boxes.waves(points(3)))
        while gone() is not None:  # the thread lets go of it after the future is done
            gc.collect()
        thread.join(60)
        assert not thread.is_alive()


@pytest.mark.usefixtures("quick_workers")
def test_workers_end_when_nobody_has_the_pool():
    before, threads = set(multiprocessing.active_children()), set(threading.enumerate())
    pool = ProcessPool(1)
    assert torch.equal(pool.submit(black_boxes.waves, points(1)).result(60), black_boxes.waves(points(1)))
    (worker,) = set(multiprocessing.active_children()) - before
    (thread,) = set(threading.enumerate()) - threads
    gone = weakref.ref(pool)
    del pool
    while gone() is not None:
        gc.collect()
    worker.join(60)
    thread.join(60)
    assert worker.exitcode == 0
    assert not thread.is_alive()


def job(fn=black_boxes.waves, device="cpu"):
    return Job(Function(fn, None), (points(1),), torch.device(device), Batch(points(1), 0))


def test_values_that_cannot_go_to_their_device_are_an_error_of_their_call():
    one = job(device="cuda:99")
    one.batch.came(one.batch.take(), part(torch.zeros(1)))
    one.settle()
    assert one.future.exception(0) is not None


def test_a_call_can_be_cancelled_until_its_first_point_is_given_to_a_worker():
    one, other, given = job(), job(), []
    worker = SimpleNamespace(ready=True, kept={}, give=lambda *what: given.append(what[0]))
    worker.give_function = lambda number, *_: worker.kept.update({number: None})
    with ProcessPool(1) as pool:
        pool._staffed = [worker]
        for expected in ([], [one]):
            pool._assign([one])  # the black box, then the point
            assert given == expected
            assert one.future.running() == bool(expected)
        pool._staffed = []
    assert not one.future.cancel()
    assert other.waiting
    assert other.future.cancel()
    assert not other.begin()
    assert other.over
    assert other.future in concurrent.futures.wait([other.future], 0).done


def test_a_black_box_that_takes_too_much_memory_when_it_is_made_ends_its_own_calls():
    one, other = job(), job(black_boxes.picture)
    worker = SimpleNamespace(job=None, chunk=None, number=one.function.number, end=lambda grace: "SIGKILL")
    with ProcessPool(1) as pool:
        pool._staffed = [worker]
        pool._lose(worker, [one, other], "it took too much")
    assert "it took too much" in str(one.error)
    assert other.error is None
