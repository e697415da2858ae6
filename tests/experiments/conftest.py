"""What tests of the harness share."""

from types import SimpleNamespace

import pytest

from experiments.ensembles import workers


@pytest.fixture
def one_process(monkeypatch):
    """Jobs of ensembles are run here, one by one: a process of their own would import everything anew."""

    def run_jobs(jobs, count):
        for job in jobs:
            messages = []
            end = workers._execute(job, SimpleNamespace(send=messages.append))
            yield from ((job, message) for message in [*messages, end])

    monkeypatch.setattr("experiments.ensembles.ensemble.run_jobs", run_jobs)


@pytest.fixture
def no_curves(monkeypatch):
    """Curves take most of the time of a page."""
    monkeypatch.setattr("experiments.reports.error_curves.curves", lambda *_: None)
