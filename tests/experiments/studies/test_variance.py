"""The study of estimators, run small: slopes, ratios and truths must be right, not just there."""

import json
import math

import pytest
import torch

from experiments.problems.closed_forms import PlaneWave
from experiments.studies.estimator_choice import (
    BUDGETS,
    Case,
    cases_of,
    compare,
    draws_of_the_source,
    gradient_of_the_source,
    rival_gradients,
    second_of_optax,
    second_of_the_source,
    summary,
)
from experiments.studies.estimator_curves import Measurement, curve, slope
from experiments.studies.estimator_problems import looked_up, made_problem, quadrature
from experiments.studies.estimators import ESTIMATORS, OURS, PAPER
from experiments.studies.variance import VarianceReport, variance

pytestmark = pytest.mark.usefixtures("short_climbs")

SOBOL = "aggregate + center, sobol"


def measured(report: VarianceReport, *wanted: object) -> Measurement:
    """The one measurement of a problem, method, budget and quantity."""
    return next(m for m in report.measurements if (m.problem, m.method, m.budget, m.quantity) == wanted)


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> VarianceReport:
    out = tmp_path_factory.mktemp("variance")
    few = (OURS, PAPER, SOBOL)
    result = variance(
        runs=16, budgets=(32, 128, 512), problems=("BOX2", "WAVE10"), methods=few, side=16, out=out, rivals=0
    )
    result_files = {path.name: path for path in out.iterdir()}
    pictures = ["variance_evaluations.png", "variance_samples.png", "variance_seconds.png"]
    assert sorted(result_files) == ["variance.json", *pictures]
    written = json.loads(result_files["variance.json"].read_text())
    assert len(written["measurements"]) == len(result.measurements)
    assert written["runs"] == 16
    for name in pictures:
        assert result_files[name].read_bytes().startswith(b"\x89PNG")
    return result


@pytest.fixture
def no_figures(monkeypatch) -> None:
    """They take most of the time of a few runs."""
    monkeypatch.setattr("experiments.studies.variance.draw", lambda *_: None)


@pytest.mark.parametrize("quantity", ["value", "gradient", "hessian", "hvp"])
def test_error_of_random_samples_falls_with_the_root_of_evaluations(report, quantity) -> None:
    ours, sobol = (slope(*curve(report.measurements, "WAVE10", one, quantity, "evaluations")) for one in (OURS, SOBOL))
    # The RMSE of a normal number over 16 runs has a relative standard deviation of 1/sqrt(32) = 0.18; the slope between
    # two of them, log(16) apart, one of 0.18 sqrt(2) / 2.8 = 0.09. Four of these are allowed.
    assert ours == pytest.approx(-0.5, abs=0.36)
    assert sobol < -0.4


def test_shared_samples_beat_a_sample_set_per_element(report) -> None:
    ratio = next(r for r in report.ratios if (r.problem, r.budget, r.method) == ("BOX2", 128, PAPER))
    assert ratio.evaluations <= 128
    assert ratio.ratio > 10
    assert ratio.ratio_error < ratio.ratio / 3


@pytest.mark.filterwarnings("ignore:proposal 'uniform'")
def test_budgets_are_kept_and_nearly_used(tmp_path, no_figures) -> None:
    alone = tuple(method.name for method in ESTIMATORS if not method.memory)
    problems = ("WAVE2", "WAVE10")
    report = variance(runs=2, budgets=(32, 512), problems=problems, methods=alone, out=tmp_path, rivals=0)
    assert len({(m.problem, m.method, m.budget) for m in report.measurements}) == 4 * len(alone)
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
        ({"problems": ("box3",)}, "problems must be some of BOX2, BOX10, MUG, WAVE2, WAVE10, got BOX3"),
        ({"methods": ("ours",)}, "methods must be some of aggregate"),
        ({"runs": 1}, "runs must be at least 2, got 1"),
        ({"budgets": (32, 8)}, "budgets must be at least 16, got 8"),
        ({"budgets": ()}, "budgets must be at least 16, got 0"),
        ({"side": 0}, "side must be at least 1, got 0"),
        ({"seed": -1}, "seed must be at least 0, got -1"),
        ({"rivals": -1}, "rivals must be at least 0, got -1"),
    ],
)
def test_wrong_arguments_are_named(tmp_path, wrong, message) -> None:
    with pytest.raises(SystemExit, match=message):
        variance(**{"runs": 2, "rivals": 0, "out": tmp_path, **wrong})


def test_problems_have_lower_case_names_too_and_both_tables_are_kept(tmp_path, no_figures, monkeypatch) -> None:
    kept = {}
    monkeypatch.setattr("experiments.studies.variance.may_keep", lambda name: None)
    monkeypatch.setattr("experiments.studies.variance.keep", lambda headers, rows, name: kept.update({name: rows}))
    names, chosen = ("wave10", "WAVE10"), {"methods": (OURS,), "sizes": (1,)}
    found = variance(runs=2, budgets=(32,), problems=names, **chosen, out=tmp_path, rivals=2, store="estimators")
    assert [row[:3] for row in kept["estimators"]] == [["WAVE10", OURS, 32]]
    assert {tuple(row[:2]) for row in kept["estimators_rivals"]} == {("gradient", 1), ("hvp", 1), ("hessian", 1)}
    assert {m.problem for m in found.measurements} == {"WAVE10"}
    compared = json.loads((tmp_path / "rivals.json").read_text())
    assert len(compared) == 8 * len(BUDGETS) * 3  # functions, budgets; gradient, product and Hessian


def test_a_memory_lowers_the_error_and_an_untrained_network_does_not_raise_it(tmp_path, no_figures) -> None:
    methods = tuple(OURS + more for more in ("", ", memory", ", untrained network"))
    problems = ("BOX2", "WAVE2")
    # Estimates with and without a memory have other samples: few runs would compare noise.
    report = variance(runs=96, budgets=(32,), problems=problems, methods=methods, side=16, out=tmp_path, rivals=0)
    for quantity in ("value", "gradient", "hessian", "hvp"):
        for problem, gain in (("WAVE2", 0.2), ("BOX2", 1.2)):  # images of BOX2 are hard to predict
            plain, memory, untrained = (measured(report, problem, name, 32, quantity).rmse for name in methods)
            assert memory < gain * plain
            assert untrained < 1.2 * plain


def test_a_memory_lowers_the_error_of_every_proposal(tmp_path, no_figures) -> None:
    """It explains a plane wave nearly. None is compared per element."""
    plain = tuple(f"{kind} + center" for kind in ("gaussian", "uniform", "per-element"))
    methods = tuple(name + more for name in plain for more in ("", ", memory"))
    report = variance(runs=8, budgets=(32,), problems=("WAVE2",), methods=(OURS, *methods), out=tmp_path, rivals=0)
    for name in plain:
        for quantity in ("gradient", "hessian", "hvp"):
            without, memory = (measured(report, "WAVE2", name + more, 32, quantity).rmse for more in ("", ", memory"))
            assert memory < 0.5 * without, (name, quantity)
    assert {ratio.method for ratio in report.ratios} == {"per-element + center"}


def test_every_proposal_has_a_memory_of_its_own_evaluations() -> None:
    problem = made_problem("WAVE2", 1000, 16, 0)
    remembering = [one for one in ESTIMATORS if one.memory == "process"]
    for one in remembering:
        one.estimate(problem, lambda fn: fn, 32, 0)
    points = [memory.points for memory in problem.memories.values()]
    assert len(points) == len(remembering) == 4
    for k, some in enumerate(points):
        assert not any(some.shape == others.shape and torch.equal(some, others) for others in points[:k])


def test_samples_per_element_are_fewer_where_every_element_has_its_own(report) -> None:
    ours, theirs = (measured(report, "BOX2", name, 512, "hessian") for name in (OURS, PAPER))
    assert ours.evaluations - 2 <= ours.samples <= 512
    # a pair for the gradient's and the Hessian's elements each: 2 (1 + 2 + 3) evaluations
    assert theirs.samples == 2 * (theirs.evaluations // 12)


def test_quadrature_and_table_agree_with_a_closed_form() -> None:
    wave, sigma = PlaneWave(torch.tensor([2.0], dtype=torch.float64), phase=0.3), 0.4
    x, v = torch.tensor([0.7], dtype=torch.float64), torch.tensor([1.0], dtype=torch.float64)
    table = looked_up(wave(math.pi * torch.arange(4000)[:, None].double() / 4000), math.pi)
    scale = torch.tensor([sigma], dtype=torch.float64)
    for fn, error in ((wave, 1e-9), (table, 1e-5)):
        found = quadrature(fn, x, sigma, v)
        torch.testing.assert_close(found["value"], wave.value(x, scale).squeeze(), rtol=0, atol=error)
        torch.testing.assert_close(found["gradient"], wave.gradient(x, scale), rtol=0, atol=error)
        torch.testing.assert_close(found["hessian"], wave.hessian(x, scale), rtol=0, atol=error)


def test_auto_settings_have_the_least_error() -> None:
    rows = compare(sizes=(2, 10), budgets=(64,), runs=60)
    assert sum(row.kind == "held out" for row in rows) == 2 * 2 * 3
    assert len(rows) == 2 * 8 * 3
    assert max(row.ratio for row in rows) < 1.0
    headers, body = summary(rows)
    assert [row[:5] for row in body][:6] == [
        [quantity, 2, 64, kind, f"aggregate, sobol, {signs}, mean"]
        for quantity, signs in (("gradient", "single"), ("hvp", "pairs"), ("hessian", "pairs"))
        for kind in ("of the rules", "held out")
    ]
    assert all(len(row) == len(headers) for row in body)


def test_problems_are_compared_in_units_of_their_sigma() -> None:
    wave, box = (made_problem(name, 2**14, 8, 0) for name in ("WAVE2", "BOX2"))
    case, unit = Case.of(wave), torch.ones(2, dtype=torch.float64)
    form = PlaneWave(wave.fn.k * wave.sigma, phase=0.7 + math.pi / 2)
    torch.testing.assert_close(case.gradient, form.gradient(torch.zeros_like(unit), unit))
    torch.testing.assert_close(case.hessian, form.hessian(torch.zeros_like(unit), unit))
    torch.testing.assert_close(case.fn(torch.eye(2).double()), form(torch.eye(2).double()))
    rows = compare(sizes=(), budgets=(64,), runs=40, problems=[wave, box])  # a wave is among the functions already
    assert [(row.function, row.kind, row.quantity, row.n) for row in rows] == [
        ("BOX2", "BOX2", quantity, 2) for quantity in ("gradient", "hvp", "hessian")
    ]
    assert all(0.01 < row.errors["auto"] < 3 for row in rows)


def test_rivals_are_unbiased_or_as_biased_as_stated() -> None:
    """Means of 20 000 runs within 5 standard errors of the closed form: 36 comparisons."""
    k, R, K = torch.tensor([0.6, -0.8, 0.3], dtype=torch.float64), 20_000, 5
    wave, x, sigma = PlaneWave(k, phase=0.4), torch.zeros(3).double(), torch.ones(3).double()
    u = torch.randn(R, K + 1, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    found = rival_gradients(wave, u)
    generator = torch.Generator().manual_seed(3)
    first, second = (draws_of_the_source(R, K, 3, order, generator) for order in (1, 2))
    found["source"] = gradient_of_the_source(wave, *first)
    for name, gradients in found.items():
        share = K / (K + 1) if name == "EvoTorch, single" else 1.0
        error = gradients.mean(0) - share * wave.gradient(x, sigma)
        assert float((error.abs() / gradients.std(0) * math.sqrt(R)).max()) < 5, name
    hessian = wave.hessian(x, sigma)
    for v, truth in ((k, hessian @ k), (None, hessian)):
        for found_second in (second_of_optax(wave, u, v), second_of_the_source(wave, *second, v)):
            error = found_second.mean(0) - truth
            assert float((error.abs() / found_second.std(0) * math.sqrt(R)).max()) < 5


@pytest.mark.parametrize("n", [1, 2])
def test_truths_of_functions_that_are_held_out(n) -> None:
    """Stein's identities by the trapezoid rule over all parameters."""
    line = torch.linspace(-9, 9, 401, dtype=torch.float64)
    u = torch.cartesian_prod(*[line] * n).view(-1, n)
    cases = [case for case in cases_of(n) if case.kind == "held out"]
    assert [case.name for case in cases] == ["product of sines", "ridge"]
    for case in cases:
        f = case.fn(u) * torch.exp(-0.5 * u.square().sum(1)) * ((line[1] - line[0]) / math.sqrt(2 * math.pi)) ** n
        torch.testing.assert_close(f @ u, case.gradient, rtol=0, atol=1e-6)
        second = torch.einsum("k,ki,kj->ij", f, u, u) - f.sum() * torch.eye(n).double()
        torch.testing.assert_close(second, case.hessian, rtol=0, atol=1e-6)
