"""Training through a layer with memory, on a small network task."""

from dataclasses import replace

import pytest
from small import SIZE, Bump, trained


@pytest.mark.parametrize(
    ("method", "evaluations", "most", "left"),
    [
        ("memory_newton", 60, None, 0.8),  # Newton steps on the weights
        ("memory_adam", 60, None, 0.6),
        ("memory_targets", 116, None, 0.1),
        ("memory_targets", 157, 0, 0.8),  # more outputs than `MOST`: so many renders come first
        ("memory_targets", 60, 0, 0.1),  # all evaluations are used before the first step
    ],
)
def test_uses_its_evaluations_and_reduces_the_error(method, evaluations, most, left, monkeypatch):
    if most is not None:
        monkeypatch.setattr("experiments.methods.memory_networks.MOST", most)
        monkeypatch.setattr("experiments.methods.memory_networks._STEPS_ALONE", 40)
    outcome, trial = trained(method, Bump(replace(SIZE, evaluations=evaluations)), least_steps=0)
    assert outcome.evaluations == evaluations
    assert trial.rows[-1].parameter_error < left * trial.rows[0].parameter_error


def test_steps_on_the_surrogate_alone_come_between_those_with_renders():
    outcome, trial = trained("memory_adam", Bump(replace(SIZE, evaluations=60)), least_steps=50)
    used = [row.evaluations for row in trial.rows]
    assert (outcome.evaluations, len(used)) == (60, 51)  # a row at the start, and one after each step
    assert used[25] == 40  # half of those after the first 20
