"""What leaving out parts of the source's setting saves, measured on a task whose clock is known."""

import json
import math
from dataclasses import replace

import pytest
import torch
from small import TARGET, TASK

from experiments.problems.task import Renderer
from experiments.reports.ensemble_page import page
from experiments.reports.savings import Saving
from experiments.studies.full_setting import full_setting, line, saving


class Clock:
    """Time that passes only when a loss says so."""

    def __init__(self):
        self.now, self.calls, self.released = 0.0, 0, False

    def release(self):
        self.released = True

    def alone(self, loss):
        def evaluate(x):
            assert self.released  # by the task that was measured before
            return loss(x)

        return evaluate

    def loss(self, seconds, factor):
        def evaluate(x):
            self.calls += 1
            self.now += next(seconds)
            return factor * TASK.loss(x)

        return evaluate


@pytest.fixture
def halved(monkeypatch):
    """`bowl` in 3 ms, its full setting in 36 ms with a loss that is larger by a quarter; both load for 100 s."""
    clock = Clock()
    monkeypatch.setattr("experiments.studies.full_setting.time.perf_counter", lambda: clock.now)
    whole = replace(TASK, loss=clock.alone(clock.loss(iter([100, 0.036, 0.7, 0.036, 0.036, 0.001, 0.036]), 1.25)))
    task = replace(
        TASK,
        loss=clock.loss(iter([100, 0.003, 0.003, 0.5, 0.003, 0.003, 0.002]), 1.0),
        renderer=Renderer(release=clock.release),
    )
    return task, whole, clock


def test_saving_is_measured_at_the_same_points_without_the_loading(halved):
    task, whole, clock = halved
    points = line(TARGET + 2, TARGET)
    # The way is 2 sqrt(2) long; losses are its squared length.
    assert torch.allclose(points, TARGET + torch.tensor([2, 1.6, 1.2, 0.8, 0.4, 0]).double()[:, None])
    found = saving(task, whole, points)
    squares = [8 * t**2 for t in (1, 0.8, 0.6, 0.4, 0.2, 0)]
    rms = math.sqrt(sum((0.25 * square) ** 2 for square in squares) / 6)
    assert found == Saving(pytest.approx(0.003), pytest.approx(0.036), pytest.approx(rms / (1.25 * 8)))
    assert clock.calls == 2 * 7
    assert str(found) == ("time saved: 12x (3 ms against 36 ms per evaluation), loss differs by 10 % of its peak")


def test_times_have_units():
    assert "2x (1.5 s against 3 s" in str(Saving(1.5, 3.0, 0.0))
    text = "time saved: 120x (12 us against 1.5 ms per evaluation), loss differs by 140 % of its peak"
    assert str(Saving(1.2e-5, 1.4999e-3, 1.4)) == text


def test_the_report_shows_the_saving_that_was_measured_once(folder, halved, no_curves, monkeypatch, capsys):
    task, whole, clock = halved
    monkeypatch.setattr("experiments.problems.catalogue.FITTING", {"bowl": None})
    monkeypatch.setattr("experiments.studies.full_setting.FITTING", {"bowl": None})
    monkeypatch.setattr(
        "experiments.problems.catalogue.fitting", lambda _, preset, *__: {"fast": task, "paper": whole}[preset]
    )
    assert f"not measured: python -m experiments full_setting {folder}" in page(folder, {"bowl": task})
    assert clock.calls == 0
    full_setting(folder)
    assert "bowl: time saved: 12x (3 ms against 36 ms per evaluation)" in capsys.readouterr().out
    assert json.loads((folder / "bowl" / "saving.json").read_text())["full_seconds"] == pytest.approx(0.036)
    calls = clock.calls
    full_setting(folder)
    assert "12x (3 ms against 36 ms per evaluation)" in page(folder, {"bowl": task})
    assert clock.calls == calls == 2 * 7


def test_a_folder_whose_tasks_leave_out_nothing_is_refused(folder):
    with pytest.raises(SystemExit, match="DIR must have a task that leaves out something of the source's, got bowl"):
        full_setting(folder)


@pytest.mark.parametrize("points", [torch.zeros(2), torch.zeros(0, 2)])
def test_saving_names_what_is_wrong(points):
    with pytest.raises(ValueError, match=rf"points must be \[P, 2\], got \{list(points.shape)}"):
        saving(TASK, TASK, points)
