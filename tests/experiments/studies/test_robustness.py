"""Tasks in other circumstances, with a scene that knows its own noise, and the command that runs them."""

import csv
import math
import pickle
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from experiments.ensembles import processes
from experiments.ensembles.processes import Trouble
from experiments.problems.rendered import Setting, rendered
from experiments.problems.srgb import from_srgb, to_srgb
from experiments.problems.task import uniform
from experiments.problems.tasks import mug
from experiments.problems.variations import Change, jpeg, varied
from experiments.problems.variations import load as load_varied
from experiments.reports.results import Run, load
from experiments.reports.summary import summarize
from experiments.runs.attempt import attempt
from experiments.runs.records import Outcome, Record
from experiments.runs.trial import Trial
from experiments.studies.robustness import Cell, robustness, row

SOLUTION = torch.tensor([0.25, -0.5], dtype=torch.float64)


class Scene:
    """Ramps whose slopes are the parameters, with noise that is known for every seed and number of samples."""

    def __init__(self, setting):
        self.noise, self.setting, self.seed, self.seeds = "fixed", setting, 0, []

    def __call__(self, x):
        self.seed += self.noise == "call"
        width, height = self.setting.film
        across, down = torch.linspace(0, 1, width), torch.linspace(0, 1, height)[:, None]
        images = []
        for a, b in x.float():
            self.seed += self.noise == "point"
            self.seeds.append(self.seed)
            grain = torch.rand(height, width, 3, generator=torch.Generator().manual_seed(self.seed)) - 0.5
            images.append((0.5 + 0.3 * (a * across + b * down))[..., None] + 0.1 * grain / self.setting.spp**0.5)
        return torch.stack(images) if images else torch.empty(0)


@pytest.fixture
def scenes():
    return []


@pytest.fixture
def task(scenes):
    def scene(setting):
        scenes.append(Scene(setting))
        return scenes[-1]

    return rendered(
        name="ramps",
        title="",
        parameters="",
        scene=scene,
        moving=scene,
        variant="scalar_rgb",
        setting=Setting((16, 8), 8, 2),
        needs="",
        solution=SOLUTION,
        start=uniform(torch.full((2,), 0.5).double(), torch.ones(2).double()),
        sigma=0.5,
        bounds=(torch.full((2,), -2.0).double(), torch.full((2,), 2.0).double()),
        evaluations=100,
    )


CHANGES = [
    Change(spp=0.25),
    Change(spp=3.0),
    Change(jpeg=10),
    Change(noise="other"),
    Change(noise="call"),
    Change(noise="point"),
    Change(spp=0.25, noise="point"),
]


@pytest.mark.parametrize("change", CHANGES, ids=str)
def test_errors_are_those_of_the_task(task, change):
    other, x = varied(task, change), torch.tensor([[0.5, 0.5], [1.0, -1.0]]).double()
    other.loss(x)  # whatever a method has seen on the way
    assert other.truth.image_error(SOLUTION) == 0
    assert other.truth.image_error(x[0]) == pytest.approx(float(task.loss(x)[0]), abs=1e-12)
    assert other.truth.parameter_error(SOLUTION + 0.1) == pytest.approx(0.01)
    assert other.name == f"ramps {change}"


@pytest.mark.parametrize(
    ("change", "name"), [(Change(), ""), (Change(spp=0.25, noise="point"), "spp=0.25 noise=point")]
)
def test_names_say_what_differs(task, change, name):
    assert str(change) == name
    assert varied(task, change).name == f"ramps {name}".strip()


def test_fewer_samples_are_more_noise_in_renders_and_reference_alike(task, scenes):
    other = varied(task, Change(spp=0.25))
    assert float(other.loss(SOLUTION[None])[0]) == 0
    assert scenes[-1].setting == Setting((16, 8), 2, 2)
    clean, noisy = task.output.image(SOLUTION[None])[0], other.output.image(SOLUTION[None])[0]
    smooth = torch.linspace(0, 1, 16) * 0.3 * 0.25 + 0.5 - 0.15 * torch.linspace(0, 1, 8)[:, None]
    spread = [(image - smooth[..., None]).square().mean().sqrt() for image in (clean, noisy)]
    assert float(spread[1] / spread[0]) == pytest.approx(2.0, rel=1e-4)


def test_fresh_noise_leaves_the_reference_alone(task, scenes):
    clean, seeds = task.output.image(SOLUTION[None])[0], {}
    for noise in ("other", "call", "point"):
        other = varied(task, Change(noise=noise))
        images = torch.cat([other.output.image(SOLUTION.expand(2, 2)), other.output.image(SOLUTION.expand(1, 2))])
        seeds[noise] = scenes[-1].seeds
        assert float(other.output.residuals(clean).abs().max()) == 0  # the reference has the first seed
        expected = (images - clean).square().mean((1, 2, 3))
        again = torch.stack([other.output.loss(image) for image in images])
        torch.testing.assert_close(again, expected)
        assert float(expected.min()) > 0
    assert seeds == {"other": [0, 1, 1, 1], "call": [0, 1, 1, 2], "point": [0, 1, 2, 3]}


def test_a_compressed_reference_is_what_the_renders_are_compared_with(task):
    clean = task.output.image(SOLUTION[None])[0]
    loss = varied(task, Change(jpeg=10)).loss(SOLUTION[None])
    assert float(loss) == pytest.approx(float((clean - jpeg(clean, 10)).square().mean()))
    assert float(loss) > 0


@pytest.mark.parametrize("factor", [0.5, 1.25])
def test_starts_at_another_distance(task, factor):
    for run in range(3):
        moved = varied(task, Change(start=factor)).start(run) - SOLUTION
        torch.testing.assert_close(moved, factor * (task.start(run) - SOLUTION))


def test_noise_of_mitsuba():
    small = mug.task(variant="scalar_rgb")
    small = replace(small, setting=Setting((16, 12), 2, 2))
    x = torch.zeros(2, 1).double()
    same = varied(small, Change(spp=1.5)).loss(x)
    assert float(same.abs().max()) < 1e-12
    other, fresh = varied(small, Change(noise="other")).loss(x), varied(small, Change(noise="point")).loss(x)
    assert float(other.min()) > 1e-5
    torch.testing.assert_close(other[0], other[1])
    assert float(fresh.min()) > 1e-5
    assert abs(float(fresh[0] - fresh[1])) > 1e-6


@pytest.mark.parametrize("noise", ["fixed", "other", "call", "point"])
def test_a_run_goes_on_with_the_noise_that_would_have_come(noise, tmp_path):
    small = replace(mug.task(variant="scalar_rgb"), setting=Setting((16, 12), 2, 2))
    x = torch.zeros(2, 1).double()

    def losses(folder, *counts):
        for count in counts:  # the process starts again after each but the last
            trial = Trial(varied(small, Change(noise=noise)), "m", 0, folder)
            found = [trial.loss(x) for _ in range(count)]
            trial.close(ended=False)
        return torch.stack(found)

    whole, interrupted = losses(tmp_path / "whole", 5), losses(tmp_path / "parts", 2, 3, 5)
    torch.testing.assert_close(interrupted, whole, rtol=0, atol=0)
    assert len(whole[:, 0].unique()) == (5 if noise in ("call", "point") else 1)


def test_scenes_are_loaded_before_the_clock_starts(task, scenes):
    loaded = []

    def solve(trial):
        loaded.append(len(scenes))
        trial.loss(trial.start[None])
        loaded.append(len(scenes))

    attempt(varied(task, Change(noise="point")), "m", 0, solve)
    assert loaded[0] == loaded[1] == 2  # the scene of the task, for the errors, and its own


def test_srgb_there_and_back():
    codes = torch.arange(256, dtype=torch.uint8)
    assert to_srgb(from_srgb(codes)).tolist() == codes.tolist()
    assert float(from_srgb(torch.tensor([128]))) == pytest.approx(0.21586, abs=1e-5)  # IEC 61966-2-1


def test_jpeg_of_a_grey_that_it_can_say_exactly():
    # Code 128 is the zero of a JPEG file, so that no quality changes it; brighter than white is white.
    middle = from_srgb(torch.full((16, 16, 3), 128))
    torch.testing.assert_close(jpeg(middle, 2), middle)
    torch.testing.assert_close(jpeg(5 * torch.ones(16, 16, 3), 95), torch.ones(16, 16, 3).double(), atol=0.02, rtol=0)


def test_jpeg_of_less_quality_is_further_away():
    image = torch.rand(32, 32, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    errors = [float((jpeg(image, quality) - image).square().mean()) for quality in (95, 30, 2)]
    assert 0 < errors[0] < errors[1] < errors[2]


def test_other_processes_make_the_same_task_again():
    task = load_varied("box2", "fast", "auto", 50, Change(pairs=2))
    again = pickle.loads(pickle.dumps(task))
    assert (again.name, again.evaluations) == ("box2 pairs=2", 50)
    x = torch.tensor([[0.4, 0.6]]).double()
    assert torch.equal(again.loss(x), task.loss(x))


@pytest.mark.parametrize("change", [Change(spp=2.0), Change(start=0.5)], ids=str)
def test_what_is_not_rendered_cannot_be_changed_like_that(change):
    with pytest.raises(ValueError, match="box2"):
        load_varied("box2", "fast", "auto", None, change)


@pytest.mark.parametrize("wrong", [{"spp": 0.0}, {"start": -1.0}, {"pairs": 0}, {"jpeg": 101}, {"noise": "loud"}])
def test_changes_out_of_range(wrong):
    (name,) = wrong
    with pytest.raises(ValueError, match=name):
        Change(**wrong)


def run_of(errors, *, parameter=4.0):
    records = [
        Record("t", "m", 0, k, 0.5 * k, 10 * k, None, None, error, parameter * error) for k, error in enumerate(errors)
    ]
    return Run(Outcome("t", "m", 0, "stopped", "", 1.0, 1.0, 10, len(errors) - 1, []), records)


def test_rows_count_runs_that_got_there():
    runs = [run_of([1.0, 0.05, 0.005]), run_of([2.0, 0.1, 0.1]), run_of([1.0, 0.5, 0.25, 0.01])]
    found = row(Cell("t", "spp", "1x", "m", "t"), runs)
    assert (found.runs, found.share_90, found.share_99) == (3, 1.0, pytest.approx(2 / 3))
    assert (found.evaluations_99, found.seconds_99) == (25, 1.25)  # between 20 and 30 evaluations
    assert (found.evaluations_99_low, found.evaluations_99_high) == (22.5, 27.5)
    assert (found.seconds_99_low, found.seconds_99_high) == (1.125, 1.375)
    assert found.image_error == 0.01  # of 0.005, 0.05 and 0.01
    assert found.parameter_error == pytest.approx(0.2)  # roots of 0.02, 0.4 and 0.04
    assert row(Cell("t", "spp", "1x", "m", "t"), runs[1:2]).evaluations_99 is None


def test_runs_that_diverged_count_in_the_errors_at_the_end():
    diverged = run_of([1.0, 0.5])
    diverged.records.append(replace(diverged.records[-1], image_error=None, parameter_error=None))
    found = row(Cell("t", "spp", "1x", "m", "t"), [run_of([1.0, 0.01]), diverged, diverged])
    assert (found.image_error, found.parameter_error) == (math.inf, math.inf)
    nowhere = row(Cell("t", "spp", "1x", "m", "t"), [run_of([1.0, 0.01], parameter=math.nan)])
    assert nowhere.parameter_error is None  # the task has no true point


def test_command(tmp_path: Path, one_process, capsys):
    def command():
        return robustness(
            ("box2",),
            methods="gaussian_process,our_hvpa",
            over=("pairs=6,2", "spp=0.5"),
            runs=1,
            evaluations=200,
            out=tmp_path,
        )

    rows = command()
    printed = capsys.readouterr().out
    assert "gaussian_process has no number of pairs on box2" in printed
    assert "our_hvpa, spp = 0.5x is left out on box2: " in printed
    assert [(one.sweep, one.value, one.method) for one in rows] == [
        ("pairs", "6", "our_hvpa"),
        ("pairs", "2", "our_hvpa"),
    ]
    with (tmp_path / "robustness.csv").open() as file:
        written = list(csv.DictReader(file))
    assert [float(one["image_error"]) for one in written] == [one.image_error for one in rows]
    results = load(tmp_path)
    assert list(results.runs) == ["box2", "box2 pairs=2"]  # 6 pairs are the method's own
    for one, name in zip(rows, results.runs, strict=True):
        (run,) = results.runs[name]["our_hvpa"]
        assert one.image_error == run.records[-1].image_error / run.records[0].image_error
        assert run.records[-1].evaluations <= 200
    # One move takes two renders per pair and one of the centre.
    steps = [results.runs[name]["our_hvpa"][0].records[1].evaluations for name in results.runs]
    assert [steps[0] % 13, steps[1] % 5] == [0, 0]
    assert {one.task for one in summarize(results).rows} == set(results.runs)
    for against in ("evaluations", "seconds"):
        assert (tmp_path / f"box2-robustness-{against}.png").read_bytes().startswith(b"\x89PNG")
    assert command() == rows  # nothing is run again: seconds are the same
    with pytest.raises(SystemExit, match=r"variant = auto \(now scalar_rgb\)"):
        robustness(("box2",), methods="our_hvpa", over=("pairs=2",), runs=1, variant="scalar_rgb", out=tmp_path)


def test_missing_runs_are_counted_at_the_end(tmp_path, one_process, monkeypatch, capsys):
    """With the rows of the others."""
    execute = processes._execute

    def where_there_is_light(job, connection):
        return execute(job, connection) if job.task_name in there else Trouble("no light")

    monkeypatch.setattr(processes, "_execute", where_there_is_light)
    for there in ([], ["box2 pairs=2"]):
        with pytest.raises(SystemExit, match=rf"^{2 - len(there)} of 2 runs could not be run"):
            robustness(("box2",), methods="our_hvpa", over=("pairs=6,2",), runs=1, evaluations=60, out=tmp_path / "new")
        assert ("robustness.csv" in capsys.readouterr().out) == bool(there)


@pytest.mark.parametrize("over", ["sp", "spp=", "spp=0", "jpeg=high", "noise=loud"])
def test_wrong_sweeps(over, tmp_path):
    with pytest.raises(SystemExit, match="over"):
        robustness(("box2",), over=(over,), out=tmp_path)


def test_wrong_budget(tmp_path):
    with pytest.raises(SystemExit, match="evaluations must be at least 1, got 0"):
        robustness(("box2",), evaluations=0, out=tmp_path)
