"""What every run of the tests does, and what several folders share."""

import gc
import multiprocessing
import os
from collections.abc import Callable, Iterator
from multiprocessing.context import BaseContext
from types import SimpleNamespace

import pytest

# Libraries read it when they are loaded. Tests run side by side, and two threads each would wait for one another.
os.environ.setdefault("OMP_NUM_THREADS", "1")


@pytest.hookimpl(trylast=True)
def pytest_collection_finish() -> None:
    """Leave what thousands of tests are made of out of garbage collections, which take up to a second with it."""
    gc.freeze()


def pytest_unconfigure() -> None:
    gc.unfreeze()


@pytest.fixture
def quick_inductor() -> Iterator[None]:
    """It compiles here, not in processes that import torch first, and tries no programs for every instruction set."""
    from torch._inductor import config

    with config.patch({"compile_threads": 1, "cpp.vec_isa_ok": True}):
        yield


@pytest.fixture
def short_climbs(monkeypatch: pytest.MonkeyPatch) -> None:
    """The surrogate of a memory takes a fifth of the steps to its lengths, which are most of the time of a fit."""
    monkeypatch.setattr("torch_zerohess.surrogates.lengths._ITERATIONS", 4)


@pytest.fixture(scope="session")
def forking() -> BaseContext:
    """Return a context whose processes are forked by one process that has imported torch.

    Processes that are spawned take seconds to import torch. They are spawned where the system has no fork.
    """
    if "forkserver" not in multiprocessing.get_all_start_methods():
        return multiprocessing.get_context("spawn")
    from multiprocessing import forkserver

    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["torch_zerohess", "experiments.ensembles.processes"])
    forkserver.ensure_running()
    return context


@pytest.fixture(scope="session")
def fork_workers(forking: BaseContext) -> Callable[[pytest.MonkeyPatch], None]:
    """Let workers be forked until a patch is undone."""
    changed = SimpleNamespace(**{**vars(multiprocessing), "get_context": lambda method: forking})
    return lambda patched: patched.setattr("torch_zerohess.evaluators.lifetime.multiprocessing", changed)


@pytest.fixture
def quick_workers(fork_workers: Callable[[pytest.MonkeyPatch], None], monkeypatch: pytest.MonkeyPatch) -> None:
    """Workers are forked."""
    fork_workers(monkeypatch)
