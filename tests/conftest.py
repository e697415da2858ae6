"""What every run of the tests does, and what several folders share."""

import gc
import os
from collections.abc import Iterator

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
