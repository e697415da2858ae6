"""The figures of the source: densities against draws and integrals, orders of estimators that are known, and files."""

import math
from dataclasses import replace

import pytest
import small
import torch
from PIL import Image

from experiments.reports import supplement_figures
from experiments.reports.animation import Trace
from experiments.runs.records import Outcome, Record
from experiments.studies.estimator_curves import Measurement, draw_operators, orders
from experiments.studies.estimators import ALONE, OPERATORS
from experiments.studies.figures import FIGURES, GROUPS, arrivals, figures
from experiments.studies.gallery import trace
from experiments.studies.lobes import LOBES, distance, draw, inverse
from experiments.studies.variance import VarianceReport

LINES = [pytest.param(lobe, id=lobe.name) for lobe in LOBES if lobe.cdf]
(FR22,) = [lobe for lobe in LOBES if lobe.name == "FR22"]
PLANES = [pytest.param(lobe, id=lobe.name) for lobe in LOBES if not lobe.cdf]


@pytest.mark.parametrize("lobe", LINES)
def test_a_cdf_is_the_integral_of_the_density(lobe) -> None:
    u = torch.linspace(-12, 12, 240_001, dtype=torch.float64)
    integral = torch.cumulative_trapezoid(lobe.density(u), u)
    assert float((lobe.cdf(u[1:]) - integral).abs().max()) < 1e-4  # the box has a step between two nodes
    p = torch.linspace(0.001, 0.999, 99, dtype=torch.float64)
    torch.testing.assert_close(lobe.cdf(inverse(lobe.cdf, p)), p)


@pytest.mark.parametrize("lobe", PLANES)
def test_a_density_of_two_parameters_has_the_integral_one(lobe) -> None:
    u = torch.linspace(-9, 9, 601, dtype=torch.float64)
    values = lobe.density(torch.cartesian_prod(u, u)).reshape(601, 601)
    assert float(torch.trapezoid(torch.trapezoid(values, u), u)) == pytest.approx(1, abs=1e-3)


def test_draws_have_the_densities(tmp_path) -> None:
    """Kolmogorov and Smirnov: sqrt(4000) D > 2.69 in one of a million seeds; bins: 6 standard deviations of a share."""
    found = draw(tmp_path / "figure6.png", 4000, 7)
    assert list(found) == [one.values[0].name for one in (*LINES, *PLANES)]
    for lobe in LOBES:
        assert found[lobe.name] < (2.69 / math.sqrt(4000) if lobe.cdf else 6)
    with Image.open(tmp_path / "figure6.png") as image:
        assert image.width > image.height


@pytest.mark.parametrize("lobe", PLANES)
def test_draws_of_another_density_are_noticed(lobe) -> None:
    """Draws of every other lobe; FR22 in two dimensions is the off-diagonal lobe."""
    alike = {lobe.name, *(("Hessian, off-diagonal", "FR22") if lobe.density is FR22.density else ())}
    for other in [one.values[0] for one in PLANES]:
        u = other.draw(20_000, 7)
        assert (distance(lobe, u) < 6) == (other.name in alike), other.name
        if other is lobe and lobe.name.endswith("n = 2"):  # in one of both dimensions
            assert distance(lobe, u.flip(1)) > 20


def test_arrivals_are_those_of_every_table() -> None:
    """Medians between two runs; a run whose error is not defined has not arrived."""

    def made(*errors: float | None) -> Trace:
        rows = [Record("t", "m", 0, k, 0.0, 10 * k, None, None, one, one) for k, one in enumerate(errors)]
        return Trace(small.TASK, "m", [], rows, Outcome("t", "m", 0, "stopped", "", 0.0, 0.0, 0, 0, []))

    group = next(iter(GROUPS))
    headers, (row,) = arrivals({group: [made(1.0, 0.1, 0.01), made(1.0, 0.5, 0.1), made(1.0, None, None)]})
    assert row == [group, GROUPS[group], "2 of 3", 15.0, "1 of 3", None, "0 of 3", None]
    assert len(headers) == len(row)


def measured(method: str, samples: int, evaluations: int, rmse: float) -> Measurement:
    return Measurement("BOX2", method, evaluations, evaluations, samples, 1.0, "hessian", rmse, 0.0)


def test_which_sampling_is_best_depends_on_the_axis(monkeypatch, tmp_path) -> None:
    """Optimal: an error of 1 / sqrt(samples), six sets; aggregate: twice the variance, one set."""
    monkeypatch.setattr("experiments.studies.estimator_curves.OPERATORS", {"hessian": "Hessian"})
    rows = [
        measured(f"{kind} + center", k, sets * k, math.sqrt(factor / k))
        for kind, sets, factor in (("aggregate", 1, 2.0), ("per-element", 6, 1.0))
        for k in (10, 100)
    ]
    (name, samples, by_samples), (_, evaluations, by_evaluations) = orders(rows, "BOX2")
    assert name == "Hessian, f(x) subtracted"
    assert (samples, by_samples) == ("100 samples per element", "optimal 0.01 < aggregate 0.02")
    assert (evaluations, by_evaluations) == ("100 evaluations", "aggregate 0.02 < optimal 0.06")
    draw_operators(rows, "BOX2", tmp_path / "figure11.png")
    assert (tmp_path / "figure11.png").read_bytes().startswith(b"\x89PNG")


def test_gradients_are_of_methods_that_draw_for_nothing_else(monkeypatch) -> None:
    """BOX2: 2041 evaluations of "optimal" are 170 pairs for each of 6 elements, or 340 for each of 3."""
    for one in ALONE:
        kind = "optimal" if one.proposal == "optimal" else "other"
        assert one.samples(2041, 2) == {"optimal": 680, "other": 2040}[kind]
    monkeypatch.setattr("experiments.studies.estimator_curves.OPERATORS", {"gradient": "gradient"})
    rows = [
        replace(measured(f"{kind} + {baseline}{more}", k, k, error / math.sqrt(k)), quantity="gradient")
        for kind in ("aggregate", "uniform", "per-element")
        for baseline in ("none", "center")
        for more, error in ((", first order", 1.0), ("", 9.0))
        for k in (10, 100)
    ]
    found = orders(rows, "BOX2")
    assert [row[0] for row in found] == [f"gradient, {one} subtracted" for one in 2 * ["nothing"] + 2 * ["f(x)"]]
    assert {row[2] for row in found} == {"aggregate 0.01 < uniform 0.01 < optimal 0.01"}


def test_ways_of_a_task_with_two_parameters_are_drawn(tmp_path) -> None:
    found = [trace(small.TASK, small.HALVE, run=run) for run in range(3)]
    widths = []
    for groups in ({"first order": found}, {"first order": found, "second order": found}):
        supplement_figures.descents(groups, tmp_path / "figure8.png")
        with Image.open(tmp_path / "figure8.png") as image:
            widths.append(image.width)
    more = replace(found[0], task=replace(small.TASK, n=3))
    supplement_figures.descents({"first order": [more]}, tmp_path / "figure7.png")
    with Image.open(tmp_path / "figure7.png") as image:
        assert image.width < widths[0] < widths[1]  # no ways, one, two


def test_command(tmp_path, capsys, monkeypatch) -> None:
    with pytest.raises(SystemExit, match=r"NUMBER must be some of 6, 7, 8, 9, 10, 11, 12, 13, got 5"):
        figures(("5",), out=tmp_path)
    with pytest.raises(SystemExit, match="runs must be at least 2"):
        figures(("8",), out=tmp_path, runs=1)
    figures(("8",), out=tmp_path, runs=2, seed=2000)
    printed = capsys.readouterr().out
    assert printed.count("2 of 2") == 4 * 3
    assert (tmp_path / "figure8.png").is_file()
    asked = []
    monkeypatch.setattr("experiments.studies.figures.variance", lambda **given: asked.append(given) or noted)
    noted = VarianceReport(2, (32,), [], [], {})
    monkeypatch.setattr("experiments.studies.figures.draw_operators", lambda *_: None)
    monkeypatch.setattr("experiments.studies.figures.orders", lambda *_: [])
    figures(("11",), out=tmp_path)
    assert asked[0]["rivals"] == 0
    assert set(asked[0]["methods"]) == {*OPERATORS, *(f"{one}, first order" for one in OPERATORS)}
    assert list(FIGURES) == [str(k) for k in range(6, 14)]


def test_the_figure_of_one_task_leaves_the_overview_of_all_tasks(tmp_path, monkeypatch, capsys) -> None:
    (tmp_path / "figure9.png").write_bytes(b"all tasks")
    monkeypatch.setattr("experiments.studies.gallery.OTHER", "block_gauss_newton")  # the method itself: no second run
    monkeypatch.setattr(supplement_figures, "caustic", lambda found, seen, other, path: path.touch())
    figures(("12",), out=tmp_path, limit=0.2)
    assert (tmp_path / "figure9.png").read_bytes() == b"all tasks"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["figure12.png", "figure9.png"]
    printed = capsys.readouterr().out
    assert "caustic" in printed
    assert str(tmp_path / "figure12.png") in printed
