"""The study of losses: both smoothed objectives against moments that are known, and the command run small."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import torch

import torch_zerohess as zh
from experiments.ensembles import provenance
from experiments.problems import catalogue
from experiments.problems.soft_squares import box2
from experiments.problems.task import Picture, Task, least_squares
from experiments.problems.tasks.box2 import fitting
from experiments.reports import result_files
from experiments.runs.attempt import attempt
from experiments.studies.loss_objectives import pictures_of
from experiments.studies.loss_report import LossReport
from experiments.studies.losses import losses


def normal(count: int, n: int) -> torch.Tensor:
    points = torch.quasirandom.SobolEngine(n, scramble=True, seed=0).draw(count, dtype=torch.float64)
    return torch.special.ndtri(points)


def small_box2() -> Task:
    box = box2(16)
    return fitting(
        box,
        title="the place of a small square",
        parameters="x, y",
        evaluations=1000,
        parameter_error=lambda x: float((x - box.loss.target).square().mean()),
    )


def test_objectives_of_a_square_of_the_parameter() -> None:
    """Pictures f = x^2 p against black: E f = (x^2 + s^2) p and E f^2 = (x^4 + 6 x^2 s^2 + 3 s^4) p^2."""
    p = torch.rand(12, 12, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def image(x: torch.Tensor) -> torch.Tensor:
        return x[:, :1, None, None].square() * p

    task = replace(
        small_box2(),
        n=1,
        output=least_squares(image, torch.flatten),
        start=lambda run: torch.ones(1).double(),
        picture=Picture(lambda x: image(x[None])[0], lambda: torch.zeros(12, 12, 3)),
    )
    one = pictures_of(task)
    x, s = 0.7, 0.4
    moments = one.moments(torch.tensor([x]).double(), s, normal(1024, 1))
    power = float(p.square().mean())
    mse = list(one.losses).index("mse")
    expected = {
        "inside": ((x**4 + 6 * x**2 * s**2 + 3 * s**4) * power, (4 * x**3 + 12 * x * s**2) * power),
        "image": ((x**2 + s**2) ** 2 * power, 4 * x * (x**2 + s**2) * power),
    }
    for form, (value, slope) in expected.items():
        values, gradients = one.objective(moments, form)
        assert gradients.shape == (3, 1)
        assert float(values[mse]) == pytest.approx(value, rel=0.01)
        assert float(gradients[mse, 0]) == pytest.approx(slope, rel=0.04)
        # One estimate of the package: its relative error, with 512 evaluations, is below a tenth.
        estimate = one.estimate(torch.tensor([x]).double(), zh.Smoothing(sigma=s, samples=256, seed=0))
        assert float(one.objective(estimate, form)[1][mse, 0]) == pytest.approx(slope, rel=0.3)


def test_pictures_keep_the_loss_of_the_task() -> None:
    """BOX2 as it is; the sphere of BRDF fills a part of its picture, and black pixels add nothing."""
    for name in ("box2", "brdf"):
        task = catalogue.fitting(name)
        one = pictures_of(task)
        changed = one.with_loss("mse", 7)
        assert changed.evaluations == 7
        x = torch.stack([task.start(run) for run in range(3)])
        share = task.output.image(x[:1]).numel() / one.render(x[:1]).numel()
        assert share == 1 or 0.5 < share < 0.7  # pi / 4 of a frame of 1.1 radii
        assert torch.allclose(changed.loss(x), share * task.loss(x), rtol=1e-6)
        assert float(changed.output.loss(changed.output.image(x[:1])[0])) == pytest.approx(
            share * float(task.loss(x[:1])[0])
        )


def test_tasks_without_a_picture_are_refused() -> None:
    with pytest.raises(SystemExit, match="tasks must be some whose image is a picture, got quad"):
        losses(tasks=("quad",))
    with pytest.raises(SystemExit, match=r"tasks must be some of .* got box3 \(did you mean box2"):
        losses(tasks=("box3",))


@pytest.mark.parametrize("wrong", [{"runs": 1}, {"samples": ()}, {"truth": 2}, {"sweep": 0}, {"evaluations": -1}])
def test_wrong_arguments_of_the_command_are_named(wrong) -> None:
    with pytest.raises(
        SystemExit, match="runs must be at least 2, samples at least 1, truth and sweep at least 16, evaluations"
    ):
        losses(**wrong)


SMALL = {"tasks": ("box2",), "runs": 4, "samples": (1, 16), "truth": 128, "sweep": 16, "evaluations": 60}


@pytest.fixture(scope="module")
def measured(tmp_path_factory) -> Iterator[tuple[LossReport, Path]]:
    out = tmp_path_factory.mktemp("losses")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("experiments.studies.losses.fitting", lambda name: small_box2())
        threads = []
        patch.setattr(torch, "set_num_threads", threads.append)
        found = losses(**SMALL, out=out)
        assert threads == [1]
        written = json.loads((out / "losses.json").read_text())
        assert len(written["biases"]) == len(found.biases) == 2 * 3 * 2
        assert len((out / "sweep.csv").read_text().splitlines()) == 1 + 12 * len(written["positions"])
        assert (out / "sweep.png").read_bytes().startswith(b"\x89PNG")
        yield found, out


@pytest.fixture(scope="module")
def report(measured) -> LossReport:
    return measured[0]


def fail(*_, **__):
    raise NotImplementedError


def test_a_second_call_measures_nothing_again(monkeypatch, measured) -> None:
    first, out = measured
    lines = (out / "parts.jsonl").read_bytes().splitlines(keepends=True)
    assert len(lines) == 2 + 3 + 3 * 2 * 4  # curves; places of gradients; fits: losses, forms, runs
    (out / "parts.jsonl").write_bytes(b"".join(lines[:-1]) + lines[-1][:9])  # killed in the last line
    again = []
    monkeypatch.setattr(
        "experiments.studies.losses.attempt", lambda *rest, **more: again.append(rest[2]) or attempt(*rest, **more)
    )
    for name in ("curves_along", "_gradient_errors", "draw"):
        monkeypatch.setattr(f"experiments.studies.losses.{name}", lambda *_, **__: None)
    second = losses(**SMALL, out=out)
    assert again == [3]
    assert (second.biases, second.errors) == (first.biases, first.errors)
    assert [fit.evaluations for fit in second.fits] == [fit.evaluations for fit in first.fits]
    monkeypatch.setattr("experiments.studies.losses.settings", lambda method, task: {"sigma": 0.7})
    monkeypatch.setattr("experiments.studies.losses.attempt", fail)
    with pytest.raises(NotImplementedError):  # fits depend on the settings of their method
        losses(**SMALL, out=out)


def test_errors_of_gradients_are_stored_without_fits(monkeypatch, measured, tmp_path) -> None:
    first, out = measured
    monkeypatch.setattr(result_files, "RESULTS", tmp_path)
    monkeypatch.setattr(provenance, "code", lambda: {"commit": 40 * "0", "clean": True})
    found = losses(**SMALL | {"evaluations": 0}, out=out, store="losses")
    assert (found.errors, found.fits) == (first.errors, [])
    table = result_files.read("losses")
    assert len(table) == len(first.errors) // 2
    assert table["image"].tolist() == pytest.approx([one.rmse for one in first.errors if one.form == "image"], rel=1e-5)


def test_the_loss_of_a_mean_picture_is_at_most_the_mean_loss(report) -> None:
    """Jensen's inequality, for the convex losses and whatever the sample."""
    for inside, image in zip(report.biases[::2], report.biases[1::2], strict=True):
        assert (inside.form, image.form, inside.loss) == ("inside", "image", image.loss)
        if inside.loss != "ssim":
            assert all(a >= b for a, b in zip(inside.values, image.values, strict=True))


def test_objectives_of_squares_are_smallest_at_the_solution_when_sigma_is_small(report) -> None:
    narrow = min(bias.sigma for bias in report.biases)
    for bias in report.biases:
        if bias.sigma == narrow and bias.loss != "ssim":
            assert abs(bias.minimum) < 0.05


def test_gradient_errors_fall_with_samples(report) -> None:
    for where in ("start", "half way", "near"):
        for form in ("inside", "image"):
            errors = {
                one.evaluations: one.rmse
                for one in report.errors
                if (one.where, one.form, one.loss) == (where, form, "mse")
            }
            assert sorted(errors) == [3, 33]
            assert errors[33] < errors[3]


def test_fits_get_there(report) -> None:
    shares = {(fit.loss, fit.form, fit.metric): fit.share for fit in report.fits}
    assert len(shares) == 3 * 2 * 2
    assert shares["mse", "image", "image"] == 1.0
    for fit in report.fits:
        assert (fit.evaluations is None) == (fit.share < 0.5)
        assert fit.evaluations is None or 2 < fit.evaluations <= 60
