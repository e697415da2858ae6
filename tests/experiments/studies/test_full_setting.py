"""The study of what tasks leave out, on tasks whose times and losses are known."""

import math
from dataclasses import replace

import pytest
import torch
from small import TARGET, TASK

from experiments.problems import catalogue
from experiments.problems.rendered import RenderedTask, Setting
from experiments.problems.task import Renderer
from experiments.studies import full_setting as study

LOADING = 100.0
SHARES = torch.linspace(1, 0, study.POINTS).double()
"""Distance from the solution, over that of the start."""


class Clock:
    """Time that passes only when a loss says so, and the scenes that are loaded."""

    def __init__(self, monkeypatch):
        self.now, self.loaded = 0.0, set()
        monkeypatch.setattr(study.time, "process_time", lambda: self.now)

    def task(self, seconds, change, film):
        """A bowl whose loss is changed; its first evaluation loads it, and every fifth one takes long."""
        calls = []

        def loss(x):
            assert self.loaded <= {film}  # two loaded scenes slow each other down
            self.now += seconds if film in self.loaded else LOADING
            self.now += LOADING * (len(calls) % 5 == 4)
            self.loaded.add(film)
            calls.append(len(x))
            return change(TASK.loss(x))

        return RenderedTask(
            **vars(replace(TASK, loss=loss, renderer=Renderer(release=lambda: self.loaded.remove(film)))),
            solution=TARGET,
            setting=Setting(film, 8, 2),
            scene=None,
            moving=None,
        )


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


def largest():
    return float(TASK.loss(TASK.start(0)[None])[0])


def test_times_are_medians_without_the_loading_and_scenes_are_freed(clock):
    found = study.saving(
        clock.task(0.003, lambda loss: loss, (64, 48)), clock.task(0.036, lambda loss: loss, (256, 192))
    )
    assert (found.seconds, found.full_seconds) == (pytest.approx(0.003), pytest.approx(0.036))
    assert found.ratio == pytest.approx(12)
    assert (found.difference, found.scaled_difference) == (0, pytest.approx(0, abs=1e-9))
    assert found.task == "BOWL"
    assert (found.used, found.full) == (
        "64x48 pixels, 8 samples per pixel, depth 2",
        "256x192 pixels, 8 samples per pixel, depth 2",
    )
    assert not clock.loaded


def test_a_factor_of_the_loss_is_a_difference_before_scaling_only(clock):
    """The loss is the squared distance from the solution, here times 2: d(t) = 2 t^2 - t^2."""
    found = study.saving(clock.task(1.0, lambda loss: 2 * loss, (8, 8)), clock.task(1.0, lambda loss: loss, (16, 16)))
    assert found.difference == pytest.approx(100 * math.sqrt(float((SHARES**4).mean())))
    assert found.scaled_difference == pytest.approx(0, abs=1e-9)


def test_another_shape_is_a_difference_after_scaling(clock):
    """Losses t^4 and t^2 at distances t: least squares tell the factor."""
    peak = largest()
    found = study.saving(
        clock.task(1.0, lambda loss: loss**2 / peak, (8, 8)), clock.task(1.0, lambda loss: loss, (16, 16))
    )
    used, full = SHARES[:, None] ** 4, SHARES**2
    rest = full - used[:, 0] * torch.linalg.lstsq(used, full[:, None]).solution[0]
    assert found.difference == pytest.approx(100 * float((used[:, 0] - full).square().mean().sqrt()))
    assert found.scaled_difference == pytest.approx(100 * float(rest.square().mean().sqrt()))


def test_all_tasks_are_measured_in_both_presets_and_kept(clock, monkeypatch, capsys):
    seconds, kept, loaded = {"fast": 0.5, "paper": 2.0}, {}, []

    def load(name, preset, variant):
        loaded.append((name, preset, variant))
        return clock.task(seconds[preset], lambda loss: loss, (len(loaded), 8))

    monkeypatch.setattr(catalogue, "load", load)
    monkeypatch.setattr(study.result_files, "may_keep", lambda name: None)
    monkeypatch.setattr(study.result_files, "keep", lambda headers, rows, name: kept.update({name: (headers, rows)}))
    rows = study.full_setting(variant="scalar_rgb", store="savings")
    assert loaded == [(name, preset, "scalar_rgb") for name in catalogue.RENDERED for preset in ("fast", "paper")]
    assert [row.ratio for row in rows] == [pytest.approx(4)] * len(catalogue.RENDERED)
    headers, cells = kept["savings"]
    assert [len(row) for row in cells] == [len(headers)] * len(rows)
    assert "difference after scaling [%]" in capsys.readouterr().out
    with pytest.raises(SystemExit, match=r"tasks must be some of mug, .*, got quad"):
        study.full_setting(("quad",))
