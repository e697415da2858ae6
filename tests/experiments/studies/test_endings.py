"""The study of how searches of convex functions end: every method, and the table against made-up ends."""

import math

import pytest
import torch
from black_boxes import counting

from experiments.problems.smooth_losses import functions, lowest
from experiments.studies import endings as module
from experiments.studies.endings import CONVEX, HEADERS, METHODS, End, ended, endings, row


@pytest.mark.parametrize(("method", "box"), [(method, number % 2 > 0) for number, method in enumerate(METHODS)])
def test_every_method_ends_at_the_minimum(method, box):
    function, start = functions(2, 3)["logistic regression"], torch.tensor([1.5, -0.5], dtype=torch.float64)
    counted, calls = counting(function)
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
    assert len(rows) == 2 * len(CONVEX)
    assert "worst ratio" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="n must be 2 or more"):
        endings(n=(1,))
