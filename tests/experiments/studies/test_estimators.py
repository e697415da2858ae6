"""The study of estimators, run small: slopes, ratios and truths must be right, not just there."""

import json

import pytest

from experiments.studies.estimator_methods import OURS, PAPER
from experiments.studies.estimators import ErrorReport, error


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> ErrorReport:
    out = tmp_path_factory.mktemp("error")
    result = error(runs=16, budgets=(32, 128, 512), problems=("BOX2", "WAVE10"), side=32, out=out)
    result_files = {path.name: path for path in out.iterdir()}
    assert sorted(result_files) == ["error.json", "error_evaluations.png", "error_seconds.png"]
    written = json.loads(result_files["error.json"].read_text())
    assert len(written["measurements"]) == len(result.measurements)
    assert written["runs"] == 16
    for name in ("error_evaluations.png", "error_seconds.png"):
        assert result_files[name].read_bytes().startswith(b"\x89PNG")
    return result


@pytest.mark.parametrize("quantity", ["value", "gradient", "hessian", "hvp"])
def test_error_of_random_samples_falls_with_the_root_of_evaluations(report, quantity) -> None:
    slope = report.slope("WAVE10", OURS, quantity)
    # The RMSE of a normal number over 16 runs has a relative standard deviation of 1/sqrt(32) = 0.18; the slope between
    # two of them, log(16) apart, one of 0.18 sqrt(2) / 2.8 = 0.09. Four of these are allowed.
    assert slope == pytest.approx(-0.5, abs=0.36)
    assert report.slope("WAVE10", "aggregate + center, sobol", quantity) < -0.4


def test_shared_samples_beat_a_sample_set_per_element(report) -> None:
    ratio = next(r for r in report.ratios if (r.problem, r.budget, r.method) == ("BOX2", 128, PAPER))
    assert ratio.evaluations <= 128
    assert ratio.ratio > 10
    assert ratio.ratio_error < ratio.ratio / 3


def test_budgets_are_kept_and_nearly_used(report) -> None:
    for m in report.measurements:
        samples_of_one_per_element = 2 * (1 + 10 + 55) + 1
        if m.method.startswith("per-element") and m.problem == "WAVE10" and m.budget < samples_of_one_per_element:
            assert m.evaluations in (66, 132, 133)
        else:
            assert m.evaluations <= m.budget
            assert m.evaluations > 0.7 * m.budget


def test_the_truth_is_far_better_than_what_it_judges(report) -> None:
    best = min(m.rmse for m in report.measurements if m.problem == "BOX2" and m.quantity == "hessian")
    assert report.truth_error["BOX2"]["hessian"] < best / 5
    assert report.truth_error["WAVE10"]["hessian"] == 0


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"problems": ("box3",)}, "problems must be some of BOX2, BOX10, WAVE10, got BOX3"),
        ({"runs": 1}, "runs must be at least 2, got 1"),
        ({"budgets": (32, 8)}, "budgets must be at least 16, got 8"),
        ({"budgets": ()}, "budgets must be at least 16, got 0"),
        ({"side": 0}, "side must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
    ],
)
def test_wrong_arguments_of_error_are_named(tmp_path, wrong, message) -> None:
    with pytest.raises(SystemExit, match=message):
        error(**{"runs": 2, "out": tmp_path, **wrong})


def test_problems_have_lower_case_names_too(tmp_path) -> None:
    found = error(runs=2, budgets=(32,), problems=("wave10", "WAVE10"), out=tmp_path)
    assert {m.problem for m in found.measurements} == {"WAVE10"}
