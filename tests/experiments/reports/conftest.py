"""A folder of runs that tests of reports share."""

import pytest
from written_runs import write

from experiments.runs.records import Files


@pytest.fixture
def folder(tmp_path):
    """Every row takes half a second, and 3 evaluations with gaussian_process, 30 with our_g."""
    write(tmp_path, "gaussian_process", 0, [100.0, 10.0, 1.0, 0.1], each=3)
    write(tmp_path, "gaussian_process", 1, [200.0, 200.0, 2.0, 0.2], each=3)
    write(tmp_path, "our_g", 0, [100.0, 10.0, 5.0, 1.0], each=30, status="time limit", reason="more than 600 s")
    write(tmp_path, "our_g", 1, [200.0, None, 20.0, 200.0], each=30, status="failed", reason="ValueError: no")
    write(tmp_path, "our_g", 2, [300.0, 300.0, 300.0, 30.0], each=30, status="failed", reason="ValueError: no")
    Files(tmp_path / "bowl" / "our_g", 3).journal.touch()
    return tmp_path
