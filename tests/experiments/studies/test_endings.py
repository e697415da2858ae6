"""The study of how searches of convex functions end: against closed forms, and its table against made-up ends."""

import math

import pytest
import torch

from experiments.studies import endings as module
from experiments.studies.endings import HEADERS, METHODS, End, ended, endings, functions, lowest, row


@pytest.mark.parametrize("name", functions(3, 0))
def test_functions_are_convex(name):
    function = functions(3, 1)[name]
    a, b = 5 * torch.randn(2, 200, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert bool((function(0.5 * (a + b)) < 0.5 * (function(a) + function(b))).all())


def test_minima_are_those_of_closed_forms():
    minima = {name: lowest(function, 4) for name, function in functions(4, 5).items()}
    exponentials = 4 * (2 ** (1 / 3) + 2 ** (-2 / 3))
    assert minima["sphere"] == pytest.approx(0.0, abs=1e-20)
    assert minima["log cosh, condition 100"] == pytest.approx(0.0, abs=1e-14)
    assert minima["exponentials"] == pytest.approx(exponentials, rel=1e-14)
    assert minima["pseudo-Huber"] == pytest.approx(4.0, rel=1e-14)


@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_ends_at_the_minimum(method, box):
    function, start = functions(2, 3)["logistic regression"], torch.tensor([1.5, -0.5], dtype=torch.float64)
    calls = []

    def counted(z):
        calls.append(len(z))
        return function(z)

    end = ended(method, counted, start, lowest(function, 2), box=box, seed=0)
    assert abs(end.error) < 1e-8
    assert 10 < end.evaluations == sum(calls) - 1  # the last call is for the loss at the start


def test_a_row_has_medians_and_ratios(monkeypatch):
    counts = {"restarts=0": (10, 40, 20), "default": (50, 60, 70), "cobyqa": (20, 20, 20), "py_bobyqa": (1, 2, 3)}
    errors = {"restarts=0": 1e-9, "cobyqa": 1e-7}

    def made_up(method, function, start, minimum, *, box, seed):
        return End(counts[method][seed], errors.get(method, 1.0) * seed)

    monkeypatch.setattr(module, "ended", made_up)
    found = dict(zip(HEADERS, row("sphere", 2, 3, 0, box=True), strict=True))
    assert [found[name] for name in ("function", "parameters", "box", "runs")] == ["sphere", 2, "yes", 3]
    assert [found[method] for method in METHODS] == [20, 60, 20, 2]
    assert found["ratio"] == pytest.approx(math.cbrt(0.5 * 2.0 * 1.0))
    assert found["worst ratio"] == 2.0
    assert (found["error left"], found["error of cobyqa"]) == (2e-9, 2e-7)


def test_the_table_is_printed_and_bad_input_refused(monkeypatch, capsys):
    monkeypatch.setattr(module, "ended", lambda *job, **options: End(7, 0.0))
    rows = endings(n=(2,), runs=1)
    assert len(rows) == 2 * len(functions(2, 0))
    assert "worst ratio" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="n must be 2 or more"):
        endings(n=(1,))
