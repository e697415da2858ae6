"""The stability study: every case is right, and a wrong closed form is noticed."""

import json
from dataclasses import replace

import pandas as pd
import pytest

from experiments.problems.closed_forms import ClosedForm, PlaneWave
from experiments.reports import result_files
from experiments.studies.coverage import Coverage, _off
from experiments.studies.coverage import _rows as _coverage_rows
from experiments.studies.stability import _rows, stability
from experiments.studies.stability_cases import Case, cases
from experiments.studies.stability_searches import ENDLESS, _row, hard_cases, searches


def test_every_case_of_stability_is_right(tmp_path, capsys, monkeypatch) -> None:
    told = Coverage("wave", "aggregate, random", 16, 0.95, {"value": (0.9, 0.91)}, "right")
    monkeypatch.setattr("experiments.studies.stability.coverage", lambda **_: [told])
    rows = stability(largest=1000, runs=0, out=tmp_path / "stability.json")  # a wrong row would raise SystemExit
    assert {row.verdict for row in rows} == {"right", "right: refused"}
    # Far from zero twice, sigma 1e308, and a Hessian of order 1e320 and its diagonal.
    assert sum(row.verdict == "right: refused" for row in rows) == 5
    written = json.loads((tmp_path / "stability.json").read_text())
    assert [len(written[name]) for name in ("accuracy", "coverage", "searches")] == [len(rows), 1, 0]
    assert "WRONG" not in capsys.readouterr().out


def test_stability_keeps_its_three_tables(monkeypatch) -> None:
    kept = {}
    monkeypatch.setattr("experiments.studies.stability.may_keep", lambda name: None)
    monkeypatch.setattr("experiments.studies.stability.keep", lambda headers, rows, name: kept.update({name: rows}))
    case = next(case for case in cases(1) if case.name == "sigma 1e+00, float64")
    monkeypatch.setattr("experiments.studies.stability.cases", lambda largest: [case])
    interval = Coverage("wave", "aggregate, random", 16, 0.95, {"value": (0.9, 0.91)}, "right")
    monkeypatch.setattr("experiments.studies.stability.coverage", lambda **_: [interval])
    rows = stability(runs=0, store="extreme")
    assert [row[:2] for row in kept["extreme"]] == [[case.name, row.quantity] for row in rows]
    assert kept["extreme_intervals"] == [interval.cells()]
    assert kept["extreme_searches"] == []


def test_what_is_stored_is_right() -> None:
    verdicts = pd.concat([result_files.read(f"stability{part}")["verdict"] for part in ("", "_intervals", "_searches")])
    told = ("right", "right: refused", "few or skewed draws", "too short: ", "too long: ")
    assert all(verdict.startswith(told) for verdict in verdicts)


class Twice(ClosedForm):
    """A wave whose closed form is wrong by a factor of two."""

    def __init__(self, form: PlaneWave) -> None:
        self.form = form

    def __call__(self, points):
        return self.form(points)

    def smoothed(self, x, sigma):
        return 2 * self.form.smoothed(x, sigma)


def test_stability_notices_wrong_derivatives(monkeypatch, capsys) -> None:
    case = next(case for case in cases(1) if case.name == "sigma 1e+00, float64")
    wrong = Case("wrong", Twice(case.form), case.x, case.sigma)
    assert {row.quantity for row in _rows(wrong, 0) if row.verdict.startswith("WRONG")} >= {"value", "gradient", "HVP"}
    monkeypatch.setattr("experiments.studies.stability.cases", lambda largest: [case, wrong])
    monkeypatch.setattr("experiments.studies.stability.coverage", lambda **_: [])
    with pytest.raises(SystemExit) as stopped:
        stability(runs=0)
    assert stopped.value.code == 1
    assert "WRONG: more than 5 standard errors" in capsys.readouterr().out


def test_stability_notices_what_should_have_been_refused() -> None:
    case = next(case for case in cases(1) if case.name == "sigma 1e+00, float64")
    assert [row.verdict for row in _rows(replace(case, refused="everything"), 0)] == ["WRONG: not refused"]


def test_shares_of_intervals_are_told_and_judged(monkeypatch, capsys) -> None:
    shares = {"value": (0.9, 0.91), "gradient": (0.95, 0.96)}
    rows = [Coverage("wave", "aggregate, random", 16, 0.95, shares, verdict) for verdict in ("right", "WRONG")]
    monkeypatch.setattr("experiments.studies.stability.coverage", lambda **_: rows)
    monkeypatch.setattr("experiments.studies.stability.cases", lambda largest: [])
    with pytest.raises(SystemExit):
        stability(runs=0)
    assert "0.900 to 0.910" in capsys.readouterr().out


def test_standard_errors_of_half_the_size_are_noticed(monkeypatch) -> None:
    settings = {"proposal": "aggregate", "sampler": "random", "baseline": "center"}
    for name, draws in (("wave", 16), ("exponential", 64)):
        rows = _coverage_rows(name, settings, True, draws, 0, 1000)
        assert [row.verdict for row in rows] == ["right", "right"]
    monkeypatch.setattr("torch_zerohess.estimation.result.student_factor", lambda level, degrees: 0.5 * degrees**0)
    rows = _coverage_rows("wave", settings, True, 16, 0, 1000)
    assert [row.verdict for row in rows] == ["WRONG: too short: value, gradient, hessian, hvp"] * 2
    skewed = _coverage_rows("exponential", settings, True, 64, 0, 1000)
    assert [row.verdict.split(":")[0] for row in skewed] == ["too short", "WRONG"]


def test_what_is_too_short_on_skewed_draws_is_told() -> None:
    settings = {"proposal": "aggregate", "sampler": "random", "baseline": "center"}
    rows = _coverage_rows("exponential", settings, True, 4, 0, 1000)
    assert [row.cells()[:4] for row in rows] == [
        ["exponential", "aggregate, random, center, pairs", 4, level] for level in (0.68, 0.95)
    ]
    assert rows[1].verdict.startswith("too short: ")
    assert "hessian" in rows[1].verdict


def test_intervals_are_too_short_or_too_long() -> None:
    shares = {"value": (0.90, 0.95), "gradient": (0.95, 0.999), "hessian": (0.85, 0.99), "hvp": (0.94, 0.95)}
    assert _off(shares, 0.95, 2000) == "too short: value, hessian; too long: gradient"
    assert _off({"value": (0.94, 0.96)}, 0.95, 2000) == ""


@pytest.mark.parametrize(
    "name", ["stiff, condition 1e12, n = 2", "start on a saddle", "NaN between start and minimum", ENDLESS]
)
def test_searches_on_hard_functions(name: str) -> None:
    case = next(case for case in hard_cases() if case.name == name)
    assert float(case.fn(case.start[None])) == pytest.approx(1.0)
    row = _row(case, "descent", runs=1, max_evaluations=80 if name == ENDLESS else 150, seed=0)
    assert row.verdict == "right"
    assert row.successes == (0.0 if name == ENDLESS else 1.0)
    assert ("all 80 values are equal" in row.message) == (name == ENDLESS)


def test_every_hard_case_starts_at_one_and_false_claims_are_wrong(monkeypatch, capsys) -> None:
    for case in hard_cases():
        assert float(case.fn(case.start[None])) == pytest.approx(1.0)
    easy = next(case for case in hard_cases() if case.name.startswith("stiff, condition 1e0,"))
    monkeypatch.setattr("experiments.studies.stability_searches.hard_cases", lambda: [replace(easy, aim=-1.0)])
    monkeypatch.setattr("experiments.studies.stability_searches.ENGINES", ("descent",))
    (row,) = searches(runs=1, max_evaluations=100)
    assert (row.successes, row.claims, row.verdict) == (0.0, 1, "WRONG: claims")
    monkeypatch.setattr("experiments.studies.stability.cases", lambda largest: [])
    monkeypatch.setattr("experiments.studies.stability.coverage", lambda **_: [])
    with pytest.raises(SystemExit):
        stability(runs=1)
    assert "WRONG: claims" in capsys.readouterr().out
