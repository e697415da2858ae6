"""The stability study: every case is right, and a wrong closed form is noticed."""

import json
from dataclasses import replace

import pytest

from experiments.problems.closed_forms import ClosedForm, PlaneWave
from experiments.studies.stability import Case, _cases, _rows, stability


def test_every_case_of_stability_is_right(tmp_path, capsys) -> None:
    rows = stability(largest=1000, out=tmp_path / "stability.json")  # a wrong row would raise SystemExit
    assert {row.verdict for row in rows} == {"right", "right: refused"}
    assert sum(row.verdict == "right: refused" for row in rows) == 2
    assert len(json.loads((tmp_path / "stability.json").read_text())) == len(rows)
    assert "WRONG" not in capsys.readouterr().out


class Twice(ClosedForm):
    """A wave whose closed form is wrong by a factor of two."""

    def __init__(self, form: PlaneWave) -> None:
        self.form = form

    def __call__(self, points):
        return self.form(points)

    def smoothed(self, x, sigma):
        return 2 * self.form.smoothed(x, sigma)


def test_stability_notices_wrong_derivatives(monkeypatch, capsys) -> None:
    case = next(case for case in _cases(1) if case.name == "sigma 1e+00, float64")
    wrong = Case("wrong", Twice(case.form), case.x, case.sigma)
    assert {row.quantity for row in _rows(wrong, 0) if row.verdict.startswith("WRONG")} >= {"value", "gradient", "HVP"}
    monkeypatch.setattr("experiments.studies.stability._cases", lambda largest: [case, wrong])
    with pytest.raises(SystemExit) as stopped:
        stability()
    assert stopped.value.code == 1
    assert "WRONG: more than 5 standard errors" in capsys.readouterr().out


def test_stability_notices_what_should_have_been_refused() -> None:
    case = next(case for case in _cases(1) if case.name == "sigma 1e+00, float64")
    assert [row.verdict for row in _rows(replace(case, refused=True), 0)] == ["WRONG: not refused"]
