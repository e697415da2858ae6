"""The commands of the experiments, run small: what they report must be true, not just there."""

import json
import math
import re
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

import torch_zerohess as zh
from experiments.commands import main
from experiments.problems import catalogue
from experiments.problems.closed_forms import (
    Exponential,
    GaussianBump,
    PlaneWave,
    Quadratic,
    Step,
    box2,
    box10,
    true_gradient,
    true_hessian,
    true_hvp,
)
from experiments.reports.tables import table
from experiments.studies.bench import BenchReport, bench
from experiments.studies.estimators import OURS, PAPER, ErrorReport, error
from experiments.studies.stability import Case, _cases, _rows, stability
from torch_zerohess.sampling import extension


def vector(*numbers: float) -> torch.Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


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


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"repeats": 0}, "repeats must be at least 1, got 0"),
        ({"sizes": ((2, 8), (4, 0))}, "sizes must be at least 1, got 0"),
        ({"memory_n": -1}, "memory_n must be at least 0, got -1"),
        ({"memory_samples": 0}, "memory_samples must be at least 1, got 0"),
    ],
)
def test_wrong_arguments_of_bench_are_named(wrong, message) -> None:
    with pytest.raises(SystemExit, match=message):
        bench(**wrong)


@pytest.fixture(scope="module")
def costs(tmp_path_factory) -> BenchReport:
    out = tmp_path_factory.mktemp("bench") / "bench.json"
    before, threads = extension.available, torch.get_num_threads()
    result = bench(repeats=2, sizes=((2, 8), (256, 32)), memory_n=100_000, memory_samples=32, out=out)
    assert (extension.available, torch.get_num_threads()) == (before, threads)
    assert len(json.loads(out.read_text())["timings"]) == len(result.timings)
    return result


def test_both_paths_are_timed(costs) -> None:
    assert all(t.torch > 0 for t in costs.timings)
    assert all((t.extension is not None) == extension.available for t in costs.timings)


def test_the_extension_draws_faster(costs) -> None:
    for name in ("draw", "value + gradient + HVP"):
        assert all(t.ratio > 2 for t in costs.timings if t.operation == name)


def test_bench_without_the_extension(monkeypatch, capsys) -> None:
    monkeypatch.setattr(extension, "available", False)
    (timing,) = (
        t for t in bench(repeats=1, sizes=((2, 2),), memory_n=0).timings if t.operation == "value + gradient + HVP"
    )
    assert timing.extension is None
    assert timing.ratio is None
    assert timing.torch > 0
    assert "pure torch" in capsys.readouterr().out


def test_redrawn_perturbations_are_not_kept(costs) -> None:
    stored, redrawn = costs.memory
    perturbations = 2 * 32 * 100_000 * 8 / 2**20  # MiB
    assert stored.kept - redrawn.kept > 0.7 * perturbations
    assert redrawn.kept < 0.5 * perturbations


def test_every_case_of_stability_is_right(tmp_path, capsys) -> None:
    rows = stability(largest=1000, out=tmp_path / "stability.json")  # a wrong row would raise SystemExit
    assert {row.verdict for row in rows} == {"right", "right: refused"}
    assert sum(row.verdict == "right: refused" for row in rows) == 2
    assert len(json.loads((tmp_path / "stability.json").read_text())) == len(rows)
    assert "WRONG" not in capsys.readouterr().out


class Twice:
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


@pytest.mark.parametrize(
    "form",
    [
        Quadratic(
            vector(0, 0),
            vector(3.0, -0.5),
            vector(1, 1),
            vector(0.6, 0.8),
        ),
        PlaneWave(vector(0, 0), vector(1.0, -0.7)),
        Exponential(vector(0, 0), vector(0.3, -0.5)),
        GaussianBump(vector(0, 0), vector(0.8, 1.5)),
    ],
    ids=lambda form: type(form).__name__,
)
def test_closed_forms_agree_with_quadrature(form) -> None:
    """Gauss-Hermite quadrature of f and Stein's identities, exact to rounding for these smooth functions."""
    nodes, weights = (torch.from_numpy(a) for a in np.polynomial.hermite_e.hermegauss(60))
    u, w = torch.cartesian_prod(nodes, nodes), torch.cartesian_prod(weights, weights).prod(1) / (2 * math.pi)
    x, sigma = vector(0.3, -0.2), vector(0.5, 0.9)
    f = form(x + sigma * u) * w
    hessian = ((u * f[:, None]).mT @ u - f.sum() * torch.eye(2).double()) / torch.outer(sigma, sigma)
    close = {"rtol": 1e-9, "atol": 1e-10}
    torch.testing.assert_close(form.smoothed(x, sigma), f.sum(), **close)
    torch.testing.assert_close(true_gradient(form, x, sigma), f @ u / sigma, **close)
    torch.testing.assert_close(true_hessian(form, x, sigma), hessian, **close)
    torch.testing.assert_close(true_hvp(form, x, sigma, x), hessian @ x, **close)


def test_the_convolution_of_a_step_is_the_normal_distribution_function() -> None:
    form = Step(vector(0, 0), vector(0.6, 0.8))
    x = vector(0.5, 1.0)  # 1.1 from the plane
    value = form.smoothed(x, vector(2, 2))
    assert float(value) == pytest.approx(0.5 * math.erfc(-1.1 / 2 / math.sqrt(2)), rel=1e-12)
    assert form(torch.stack([x, -x])).tolist() == [1, 0]


@pytest.mark.parametrize("task", [box2(), box10()], ids=["BOX2", "BOX10"])
def test_soft_squares(task) -> None:
    side, loss = 64, task.loss
    assert loss(loss.target[None]).item() == 0
    points = task.start + task.sigma * torch.randn(20, len(task.start), generator=torch.Generator().manual_seed(0))
    pixels = (torch.arange(side) + 0.5).double() / side
    image = torch.zeros(20, side, side).double()
    for p in points.double().clamp(0.1, 0.9).unflatten(1, (-1, 2)).unbind(1):
        x, y = (((pixels - p[:, axis, None]) / 0.1).abs() ** 10 for axis in (0, 1))
        image += (1 - 2 * (y[:, :, None] + x[:, None, :])).clamp(0, 1)
    torch.testing.assert_close(loss.image(points.double()), image.clamp(max=1), rtol=1e-12, atol=1e-12)
    starts = task.starts(1000)
    assert (starts - task.start).abs().max() <= task.half_range
    assert starts.mean(0).sub(task.start).abs().max() < 5 * task.half_range / math.sqrt(3 * 1000)


def test_box2_is_a_plateau_that_smoothing_gives_a_slope() -> None:
    task = box2()
    x = task.start.clone().requires_grad_()
    flat = task.loss(task.start + torch.linspace(-0.05, 0.05, 9).double()[:, None])
    assert float(flat.std() / flat.mean()) < 0.03
    zh.smooth(task.loss, zh.Smoothing(sigma=task.sigma, samples=2000, seed=0))(x).backward()
    assert (x.grad > 0).all()  # down is towards (0.3, 0.3)


def test_table_aligns_numbers() -> None:
    text = table(["case", "n"], [["a", 1.23456], ["bb", None], ["c", 12345.6]])
    assert text.splitlines() == ["case      n", "----  -----", "a      1.23", "bb        -", "c     12346"]


@pytest.fixture
def no_mitsuba(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mitsuba", None)


@pytest.mark.usefixtures("no_mitsuba")
def test_tasks_that_mitsuba_renders_say_that_it_is_missing() -> None:
    for name in (*catalogue.RENDERED, *catalogue.NETWORKS):
        with pytest.raises(ImportError, match=rf"task {name} needs mitsuba, .*pip install 'torch_zerohess") as raised:
            catalogue.load(name)
        assert raised.value.name == "mitsuba"
    assert catalogue.load("caustic").name == "caustic"
    assert catalogue.load("meshfit").name == "meshfit"


@pytest.mark.usefixtures("no_mitsuba")
@pytest.mark.parametrize(
    "command",
    [
        ["run", "mug"],
        ["run", "quad", "cnn", "--methods", "descent,pooled"],
        ["tune", "mug", "--method", "our_g"],
        ["losses", "--tasks", "mug"],
        ["gradients", "mug"],
    ],
    ids=" ".join,
)
def test_commands_say_what_to_install(monkeypatch, tmp_path, command) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["experiments", *command])
    with pytest.raises(SystemExit, match="needs mitsuba, which is not installed: pip install 'torch_zerohess"):
        main()
    assert not list(tmp_path.iterdir())  # nothing was run before


@pytest.mark.usefixtures("no_mitsuba")
def test_list_and_gallery_show_what_is_missing(monkeypatch, tmp_path, capsys) -> None:
    monkeypatch.setattr(sys, "argv", ["experiments", "list"])
    main()
    printed = capsys.readouterr().out
    for name in (*catalogue.RENDERED, *catalogue.NETWORKS):
        assert re.search(rf"^{name} +task {name} needs mitsuba, which is not installed", printed, re.MULTILINE)
    monkeypatch.setattr(sys, "argv", ["experiments", "gallery", str(tmp_path), "--tasks", "mug"])
    with pytest.raises(SystemExit, match="no task of this command can be shown"):
        main()
    assert "task mug needs mitsuba" in "".join(capsys.readouterr())


def test_a_reader_that_has_enough_ends_a_command_without_a_traceback() -> None:
    command = [sys.executable, "-m", "experiments", "list"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as running:
        assert running.stdout is not None
        assert running.stderr is not None
        running.stdout.close()
        said = running.stderr.read()
    assert running.returncode == 1
    assert "Traceback" not in said
    assert "BrokenPipe" not in said
