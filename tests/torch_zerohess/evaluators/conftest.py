"""Workers that the tests of one file share."""

import pytest

from torch_zerohess.evaluators import ProcessPool


@pytest.fixture(scope="module")
def shared_pool():
    with ProcessPool(2, retries=0) as one:
        yield one


@pytest.fixture
def pool(shared_pool, quick_workers):
    return shared_pool
