"""The study of what noisy searches say at their end, against results that are made up."""

from types import SimpleNamespace

import pytest
import torch

from experiments.studies import minima as module
from experiments.studies.minima import judged, minima, problems

X = torch.tensor([0.3, -0.2], dtype=torch.float64)


def told(value, slope, bend):
    """A result at X that is off by so many standard errors."""
    loss = problems(2)["quartic"].loss
    gradient, hessian = torch.func.grad(loss)(X), torch.func.hessian(loss)(X)
    errors = {"gradient": torch.full_like(X, 0.1), "hessian_diagonal": torch.full_like(X, 0.2)}
    return SimpleNamespace(
        x=X,
        value=float(loss(X)) + 0.3 * value,
        value_error=0.3,
        gradient=gradient + 0.1 * slope,
        hessian=hessian + 0.2 * torch.diag(torch.tensor(bend, dtype=torch.float64)),
        standard_errors=errors,
    )


def test_entries_within_two_errors_are_counted(monkeypatch):
    found = iter([told(1.9, 1.9, [2.1, -1.9]), told(-2.1, -2.1, [-1.9, 1.9])])
    monkeypatch.setattr(module, "_searched", lambda *job: next(found))
    row = judged("quartic", 2, 150, 2, 0)
    assert (row.value, row.gradient, row.hessian) == (0.5, 0.5, 0.75)
    mean = float(torch.func.hessian(problems(2)["quartic"].loss)(X).diagonal().abs().mean())
    first, second = (0.2 * ((a**2 + b**2) / 2) ** 0.5 / mean for a, b in ((2.1, 1.9), (1.9, 1.9)))
    assert row.error == pytest.approx((first + second) / 2, rel=1e-9)


def test_a_result_without_derivatives_covers_nothing(monkeypatch):
    result = told(0.0, 0.0, [0.0, 0.0])
    result.gradient = result.hessian = result.standard_errors = None
    monkeypatch.setattr(module, "_searched", lambda *job: result)
    row = judged("quartic", 2, 150, 1, 0)
    assert (row.value, row.gradient, row.hessian, row.error) == (1.0, 0.0, 0.0, float("inf"))


@pytest.mark.parametrize("name", problems(2))
def test_every_function_has_a_row(name):
    """Two short searches."""
    row = judged(name, 2, 40, 2, 0)
    assert (row.function, row.n, row.evaluations, row.runs) == (name, 2, 40, 2)
    assert row.gradient > 0.4
    assert row.error < 10.0


def test_the_table_is_printed_and_bad_input_refused(monkeypatch, capsys):
    monkeypatch.setattr(module, "_searched", lambda *job: told(0.0, 0.0, [0.0, 0.0]))
    rows = minima(n=(2,), evaluations=(150,), runs=1)
    assert [row.function for row in rows] == list(problems(2))
    assert "error of the Hessian" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="n must be 2 or more"):
        minima(n=(1,))
