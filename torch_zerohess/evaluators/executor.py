"""Evaluation by an executor of somebody else: the standard pools, loky, dask, mpi4py."""

import concurrent.futures
import copyreg
import functools
import hashlib
import io
import itertools
import pickle
import threading
import traceback
import uuid
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.evaluators import transfer
from torch_zerohess.evaluators.batch import MOST, Batch, Chunk
from torch_zerohess.evaluators.default_dtype import default_dtype, take_default_dtype
from torch_zerohess.evaluators.evaluator import Closing, EvaluationFuture
from torch_zerohess.evaluators.factory import Each, same
from torch_zerohess.evaluators.inline import values_without_points
from torch_zerohess.evaluators.kept import make_room, used
from torch_zerohess.evaluators.partial_values import keep_finished
from torch_zerohess.evaluators.payload import dumped_error, loaded_error
from torch_zerohess.evaluators.process_identity import become_worker, identity, in_this_process
from torch_zerohess.evaluators.random_numbers import Apart
from torch_zerohess.evaluators.values import checked_values


class Kept:
    """A black box of a worker, and how its random numbers are drawn, once it is called."""

    def __init__(self, fn: Callable[..., Any]) -> None:
        self.fn = fn
        self._apart: Apart | None = None
        self._lock = threading.Lock()

    def values(self, data: bytes) -> bytes:
        """Return the values of points and auxiliary inputs, all as bytes."""
        with self._lock:  # the workers of dask have threads
            self._apart = self._apart or in_this_process(Apart, self.fn)
            apart: Apart = self._apart
        return apart.call(functools.partial(values_of, self.fn, data))


_kept: dict[str, Kept] = {}
_lock = threading.Lock()
_numbers = itertools.count()
"""Of tasks: dask takes tasks with equal arguments for one."""

Answer = tuple[bool, Any]
"""True and the values of a chunk, or False and the error of the black box, as bytes if it comes from a process."""
Tasks = list[tuple[Chunk, "concurrent.futures.Future[Answer]"]]


class Executor(Closing):
    """Calls the black box by an executor, a few points per task.

    The executor says how the black box gets to its workers, and so what it must be: picklable for the standard
    `ProcessPoolExecutor` (use one with `mp_context` "spawn"), almost anything for loky, dask and threads. It is sent
    with every task; pass `Factory(make, *args)` for one that is large or slow to make, which each process makes once.
    A process keeps the four black boxes that were used last, of all Executors together.

    Processes use the black box as it was when the call began. If its pickled form has changed since an earlier call,
    they take the new one, and make a Factory again. For loky and dask the pickled form of a function of a script has
    the global variables that the function names. The standard `ProcessPoolExecutor` sends a function by its name: its
    global variables are those of the worker.

    Values have the same bits as with `Inline`, and random numbers differ, as described for `ProcessPool`. Of several
    exceptions of the black box, the exception of the first point is raised, also SystemExit; one that cannot be sent is
    a RuntimeError that names it. An executor whose workers ended raises its own error (`BrokenExecutor`): it has no
    limit of time and no second try, which `ProcessPool` and `Ray` have.

    The executor is the caller's: `close()` does not shut it down.

    Args:
        executor: with a method `submit(function, *arguments)` that returns a `concurrent.futures.Future`, such as
            `concurrent.futures.ProcessPoolExecutor()`, `loky.get_reusable_executor()`, dask's `client.get_executor()`.

    Example:
        >>> with concurrent.futures.ThreadPoolExecutor(2) as threads:
        ...     Executor(threads)(lambda z: z.sum(1), torch.ones(2, 3))
        tensor([3., 3.])
    """

    single_points = MOST
    """Points of a call up to which a task has one point."""

    def __init__(self, executor: concurrent.futures.Executor) -> None:
        if not callable(getattr(executor, "submit", None)):
            raise TypeError(f"executor must have a method submit, as concurrent.futures.Executor has, got {executor!r}")
        self.executor = executor
        self._names: dict[str, tuple[Callable[..., Any], bytes]] = {}
        """Black boxes, and a digest of the state of each, by the names that processes know them by."""
        self._closed = False

    def __repr__(self) -> str:
        return f"Executor({self.executor!r})"

    def __deepcopy__(self, memo: dict[int, Any]) -> "Executor":
        """Return another one of the same executor, which is the caller's: a copy of a model goes on using it."""
        return Executor(self.executor)

    def __call__(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> Tensor:
        """Return fn(points [K, n], *aux [K, ...]), values [K, *out] on the device of the points."""
        if self._closed:
            raise RuntimeError("the Executor is closed: make another one")
        if len(points) == 0:
            return values_without_points(fn, points, aux)
        batch, tasks = self._tasks(fn, points, aux)
        try:
            return _joined(batch, tasks).to(points.device)
        except BaseException as error:  # of the black box, or Ctrl-C
            keep_finished(error, points, _known(tasks))
            raise
        finally:
            for _, task in tasks:
                task.cancel()

    def submit(self, fn: Callable[..., Any], points: Tensor, *aux: Tensor) -> EvaluationFuture:
        """Return a future of what a call with these arguments returns; several may be under way."""
        if self._closed:
            raise RuntimeError("the Executor is closed: make another one")
        if len(points) == 0:
            return EvaluationFuture.of(lambda: values_without_points(fn, points, aux))
        batch, tasks = self._tasks(fn, points, aux)
        future, device = EvaluationFuture(), points.device
        future.set_running_or_notify_cancel()  # what was given to the executor is its own
        _wait_all([task for _, task in tasks], lambda: future.settle(lambda: _joined(batch, tasks).to(device)))
        return future

    def _tasks(self, fn: Callable[..., Any], points: Tensor, aux: Sequence[Tensor]) -> tuple[Batch, Tasks]:
        """Submit the chunks of points."""
        threads = isinstance(self.executor, concurrent.futures.ThreadPoolExecutor)  # they use the black box itself
        standard = isinstance(self.executor, concurrent.futures.ProcessPoolExecutor)
        state = b"" if threads else _state(fn, pickle.Pickler if standard else _pickler())
        with _lock:
            name = next((one for one, known in self._names.items() if same(known[0], fn) and known[1] == state), "")
            if not name:
                make_room(self._names)
                name = uuid.uuid4().hex
                self._names[name] = fn, state
            used(self._names, name)
        batch, tasks = Batch(points, 0), Tasks()
        try:
            while batch.waiting:
                chunk = batch.take()
                data = transfer.packed([one[chunk.start : chunk.stop] for one in (points, *aux)])
                more = identity(), next(_numbers), default_dtype()
                task = self.executor.submit(evaluated, name, fn, data, *more)
                tasks.append((chunk, task))
        except BaseException:
            for _, task in tasks:
                task.cancel()
            raise
        return batch, tasks

    def close(self) -> None:
        """Take no further points; the executor stays as it is."""
        self._closed = True
        self._names.clear()


def _state(fn: Callable[..., Any], pickler: type[pickle.Pickler]) -> bytes:
    """Return a digest of what the workers get for a black box; the same for all that are not picklable.

    The pickled form of a generator of torch has an address in it, which is another one every time.
    """
    others: Mapping[Any, Any] = copyreg.dispatch_table if pickler is pickle.Pickler else pickler.dispatch_table
    stable = type("Stable", (pickler,), {"dispatch_table": {**others, torch.Generator: _by_state}})
    file = io.BytesIO()
    try:
        stable(file).dump(fn)
    except Exception:  # what pickle raises is up to the object
        return b""
    return hashlib.sha256(file.getvalue()).digest()


def _by_state(generator: torch.Generator) -> tuple[Any, ...]:
    return torch.Generator, (str(generator.device),), transfer.packed([generator.get_state()])


def _joined(batch: Batch, tasks: Tasks) -> Tensor:
    for chunk, task in tasks:  # in order, so that the first error is of the first point
        good, data = task.result()
        if not good:
            raise loaded_error(data) if isinstance(data, bytes) else data
        batch.came(chunk, transfer.unpacked(data)[0])
    return batch.result()


def _known(tasks: Tasks) -> dict[int, Tensor]:
    """Return the values of the tasks that have succeeded, by the number of their point."""
    done = [(chunk, task) for chunk, task in tasks if task.done() and not task.cancelled() and not task.exception()]
    answers = [(chunk, *task.result()) for chunk, task in done]
    values = [(chunk, transfer.unpacked(data)[0]) for chunk, good, data in answers if good]
    return {chunk.start + k: one for chunk, rows in values for k, one in enumerate(rows.tensor())}


def _wait_all(tasks: "Sequence[concurrent.futures.Future[Any]]", then: Callable[[], object]) -> None:
    """Call `then` once, in whichever thread, when the last of the tasks is done."""
    left, lock = len(tasks), threading.Lock()

    def one_less(_: Any) -> None:
        nonlocal left
        with lock:
            left -= 1
            last = left == 0
        if last:
            then()

    for task in tasks:
        task.add_done_callback(one_less)


def evaluated(name: str, fn: Callable[..., Any], data: bytes, caller: str, number: int, dtype: str) -> Answer:
    """Return the values of a chunk, or its error, in a worker.

    The first fn with a name stays: what comes later is a copy of it. An error is returned in a form that the caller can
    read for certain: one that cannot be unpickled would break an executor of processes for good. No two tasks of a
    caller have the same number.
    """
    become_worker(caller)
    if caller != identity():
        take_default_dtype(dtype)
    with _lock:
        if name not in _kept:
            make_room(_kept)
            _kept[name] = Kept(fn)
        kept = used(_kept, name)
    try:
        return True, kept.values(data)
    except BaseException as error:  # SystemExit too
        if caller == identity():  # a thread: the error itself can be raised, but here it would end a thread of dask
            return False, error
        return False, dumped_error(error, traceback.format_exc(), _dumps)


def _pickler() -> type[pickle.Pickler]:
    """Return that of cloudpickle, which loky and dask bring: it also writes classes and functions of a script."""
    try:
        import cloudpickle
    except ModuleNotFoundError:
        return pickle.Pickler
    found: type[pickle.Pickler] = cloudpickle.Pickler
    return found


def _dumps(thing: Any) -> bytes:
    file = io.BytesIO()
    _pickler()(file).dump(thing)
    return file.getvalue()


def values_of(fn: Callable[..., Any], data: bytes) -> bytes:
    """Return the values of points and auxiliary inputs, all as bytes."""
    tensors = [one.tensor() for one in transfer.unpacked(data)]
    with torch.no_grad():
        values = checked_values(in_this_process(fn, *tensors), tensors[0], not isinstance(fn, Each))
    return transfer.packed([values])
