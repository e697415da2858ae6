"""Tables say what a method uses; here its calls on one task are counted."""

from dataclasses import replace

import pytest

from experiments.methods import METHODS
from experiments.methods.settings import settings
from experiments.problems.tasks import box2
from experiments.runs.attempt import attempt

TASK = replace(box2.task(), evaluations=12)
RUNNABLE = [name for name, method in METHODS.items() if not method.unusable(TASK)]


@pytest.mark.parametrize("name", RUNNABLE)
def test_a_method_calls_what_it_says_that_it_uses(name):
    called = set()

    def solve(trial):
        for form in ("loss", "image", "adjoint"):
            setattr(trial, form, noted(getattr(trial, form), form))
        METHODS[name](trial, settings(name, "box2"))

    def noted(call, form):
        def counted(*arguments):
            called.add(form)
            return call(*arguments)

        return counted

    attempt(TASK, name, 0, solve)
    assert called == {METHODS[name].uses.split(",")[0]}
