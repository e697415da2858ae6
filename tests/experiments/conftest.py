"""What tests of the harness share."""

from types import SimpleNamespace

import pytest
from written_runs import write

from experiments.ensembles import processes
from experiments.runs.records import Files


@pytest.fixture
def one_process(monkeypatch):
    """Jobs of ensembles are run here, one by one: a process of their own would import everything anew."""

    def run_jobs(jobs, count):
        for job in jobs:
            messages = []
            end = processes._execute(job, SimpleNamespace(send=messages.append))
            yield from ((job, message) for message in [*messages, end])

    monkeypatch.setattr("experiments.ensembles.ensemble.run_jobs", run_jobs)


@pytest.fixture
def no_curves(monkeypatch):
    """Curves take most of the time of a page."""
    monkeypatch.setattr("experiments.reports.error_curves.curves", lambda *_: None)


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
