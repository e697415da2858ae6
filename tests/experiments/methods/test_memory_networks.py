"""Training through a layer with memory, on a small network task."""

from dataclasses import replace

import pytest
from small import BUMP

from experiments.methods import METHODS
from experiments.runs.attempt import attempt


@pytest.mark.parametrize("method", ["memory_newton", "memory_adam"])
def test_uses_its_evaluations_and_reduces_the_error(method):
    trials = []
    task = BUMP.__class__(replace(BUMP.size, evaluations=60))
    outcome = attempt(task, method, 0, lambda trial: (trials.append(trial), METHODS[method](trial, {}))[1])
    assert outcome.status != "failed", outcome.traceback
    assert outcome.evaluations == 60
    rows = trials[0].rows
    assert rows[-1].parameter_error < rows[0].parameter_error
