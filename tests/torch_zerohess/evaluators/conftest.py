"""Workers that the tests of one file share, because a worker takes seconds to start."""

import pytest

from torch_zerohess.evaluators import ProcessPool


@pytest.fixture(scope="module")
def pool():
    with ProcessPool(2, retries=0) as one:
        yield one
