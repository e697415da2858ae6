"""Tables say what a method uses; here its calls on one task are counted."""

import sys
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


def test_folders_that_are_no_modules_are_not_loaded(tmp_path, monkeypatch):
    """A wheel may bring a folder with the name of another package, which would then seem to be there."""
    (tmp_path / "stray_folder").mkdir()
    monkeypatch.syspath_prepend(tmp_path)
    found = {"cma": ["cma"], "stray_folder": ["cma"], "not_there": ["cma"]}
    monkeypatch.setattr("importlib.metadata.packages_distributions", lambda: found)
    METHODS["cma_es_bounded"].load()
    assert "cma" in sys.modules
    assert "stray_folder" not in sys.modules
