"""Tables, figures and pages of an ensemble, against numbers computed by hand."""

import base64
import csv
import io
import json
import math
import re
import shlex
from dataclasses import asdict, replace

import matplotlib.image
import numpy as np
import pytest
import torch
from small import TARGET, TASK

import torch_zerohess as zh
from experiments.listing import listing
from experiments.methods import METHODS
from experiments.problems.catalogue import FITTING, load
from experiments.problems.task import Renderer
from experiments.reports.ensemble_page import page, report
from experiments.reports.error_curves import plot, quartiles, styles_of
from experiments.reports.full_setting import Saving, known_saving, line, saving
from experiments.reports.results import load as load_results
from experiments.reports.similarity import described, measures
from experiments.reports.summary import as_csv, as_json, as_text, summarize, table
from experiments.run import run
from experiments.runs.records import Files, Log, Outcome, Record, write_outcome

PER_ITERATION = 0.5
"""Seconds of every iteration below, of which 0.4 are spent in the black box."""


def write(folder, method, run, errors, *, each, status="finished", reason="both errors reduced by 99.9 %"):
    """A run of `bowl` with these image errors, `each` evaluations per iteration; parameter errors are their squares."""
    files = Files(folder / "bowl" / method, run)
    log = Log(files.log)
    for i, error in enumerate(errors):
        square = None if error is None else error**2
        log(Record("bowl", method, run, i, i * PER_ITERATION, i * each, None, None, error, square))
    log.close()
    n = len(errors) - 1
    seconds = n * PER_ITERATION
    x = TARGET.tolist()
    outcome = Outcome("bowl", method, run, status, reason, seconds, 0.8 * seconds, n * each, n, x, {"preset": "fast"})
    write_outcome(outcome, files)


@pytest.fixture
def folder(tmp_path):
    """Every row takes half a second, and 3 evaluations with gaussian_process, 30 with our_g."""
    write(tmp_path, "gaussian_process", 0, [100.0, 10.0, 1.0, 0.1], each=3)
    write(tmp_path, "gaussian_process", 1, [200.0, 200.0, 2.0, 0.2], each=3)
    write(tmp_path, "our_g", 0, [100.0, 10.0, 5.0, 1.0], each=30, status="time limit", reason="more than 600 s")
    write(tmp_path, "our_g", 1, [200.0, None, 20.0, 200.0], each=30, status="failed", reason="ValueError: no")
    write(tmp_path, "our_g", 2, [300.0, 300.0, 300.0, 30.0], each=30, status="failed", reason="ValueError: no")
    Files(tmp_path / "bowl" / "our_g", 3).journal.touch()
    return tmp_path


def cells(folder, method):
    rows = [row for row in summarize(load_results(folder)).rows if row.method == method]
    return {(row.metric, row.level): (row.evaluations, row.seconds, row.share) for row in rows}


def test_medians_are_over_the_runs_that_got_there(folder):
    assert cells(folder, "gaussian_process") == {
        ("image", 0.9): (4.5, 0.75, 1.0),  # after rows 1 and 2
        ("image", 0.99): (6.0, 1.0, 1.0),
        ("image", 0.999): (9.0, 1.5, 1.0),
        ("parameter", 0.9): (4.5, 0.75, 1.0),  # 1e4 to 1e2; 4e4 to 4
        ("parameter", 0.99): (4.5, 0.75, 1.0),
        ("parameter", 0.999): (6.0, 1.0, 1.0),
    }
    assert cells(folder, "our_g") == {
        ("image", 0.9): (60.0, 1.0, 1.0),  # after rows 1, 2 and 3; reached is reached, whatever happens later
        ("image", 0.99): (None, None, 1 / 3),
        ("image", 0.999): (None, None, 0.0),
        ("parameter", 0.9): (60.0, 1.0, 1.0),
        ("parameter", 0.99): (60.0, 1.0, 1.0),
        ("parameter", 0.999): (None, None, 1 / 3),
    }


def test_ratios_are_to_the_reference(folder):
    summary = summarize(load_results(folder))
    assert summary.reference == "gaussian_process"
    ratios = {(r.metric, r.level): (r.ratio_evaluations, r.ratio_seconds) for r in summary.rows if r.method == "our_g"}
    assert ratios == {
        ("image", 0.9): (60 / 4.5, 1 / 0.75),
        ("image", 0.99): (None, None),
        ("image", 0.999): (None, None),
        ("parameter", 0.9): (60 / 4.5, 1 / 0.75),
        ("parameter", 0.99): (60 / 4.5, 1 / 0.75),
        ("parameter", 0.999): (None, None),
    }
    (speed_up,) = summary.speed_ups
    assert (speed_up.method, speed_up.cases) == ("our_g", 3)
    assert speed_up.seconds == pytest.approx(4 / 3)
    assert speed_up.evaluations == pytest.approx(40 / 3)
    assert asdict(summary.mean_speed_up) == {**asdict(speed_up), "method": "all"}


def test_overhead_failures_and_unfinished_runs(folder):
    summary = summarize(load_results(folder))
    overheads = {one.method: (one.overhead, one.black_box) for one in summary.overheads}
    assert overheads["our_g"] == (pytest.approx(0.2 * PER_ITERATION), pytest.approx(0.8 * PER_ITERATION / 30))
    failures = {(one.method, one.status, one.reason, one.runs) for one in summary.failures}
    assert failures == {
        ("our_g", "time limit", "more than 600 s", 1),
        ("our_g", "failed", "ValueError: no", 2),
    }
    assert summary.unfinished == 1
    assert summarize(load_results(folder), methods=["our_g"]).unfinished == 1
    assert summarize(load_results(folder), methods=["gaussian_process"]).unfinished == 0


def test_the_reference_is_the_best_that_there_is(tmp_path):
    write(tmp_path, "cma_es", 0, [1.0, 0.1], each=1)
    assert summarize(load_results(tmp_path)).reference is None
    write(tmp_path, "our_hvpa", 0, [1.0, 0.1], each=1)
    write(tmp_path, "our_g", 0, [1.0, 0.1], each=1)
    assert summarize(load_results(tmp_path)).reference == "our_hvpa"


def test_the_reference_and_the_methods_can_be_chosen(folder, capsys):
    write(folder, "cma_es", 0, [100.0, 1.0], each=12)
    table(folder, format="json", reference="our_g", methods="our_g,cma_es")
    found = json.loads(capsys.readouterr().out)
    assert found["reference"] == "our_g"
    assert {row["method"] for row in found["rows"]} == {"our_g", "cma_es"}
    (ratio,) = [r for r in found["rows"] if (r["method"], r["metric"], r["level"]) == ("cma_es", "image", 0.9)]
    assert (ratio["ratio_evaluations"], ratio["ratio_seconds"]) == (12 / 60, 0.5)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"reference": "ours"}, "reference must be some of gaussian_process, our_g, got ours"),
        ({"methods": "our_h"}, "our_g"),
    ],
)
def test_a_reference_or_a_method_that_is_not_there_is_named(folder, given, message):
    with pytest.raises(SystemExit, match=message):
        table(folder, **given)


def test_a_run_that_died_before_its_first_row_counts(tmp_path):
    write(tmp_path, "our_g", 0, [1.0, 0.0], each=1)
    write_outcome(Outcome("bowl", "our_g", 1, "failed", "crash", 0, 0, 0, 0, []), Files(tmp_path / "bowl" / "our_g", 1))
    assert cells(tmp_path, "our_g")["image", 0.999] == (1.0, 0.5, 0.5)


def test_formats_agree(folder, capsys):
    summary = summarize(load_results(folder))
    parsed = json.loads(as_json(summary))
    assert parsed["rows"][0].keys() >= {"task", "method", "metric", "level", "seconds", "evaluations", "share", "runs"}
    flat = list(csv.DictReader(io.StringIO(as_csv(summary))))
    assert [{k: "" if v is None else str(v) for k, v in row.items()} for row in parsed["rows"]] == flat
    text = as_text(summary)
    assert re.search(r"^our_g +60 1s 100% +- 33% +- 0%", text, re.MULTILINE)
    assert "1 unfinished runs are left out" in text
    for name, expected in (("text", text), ("csv", as_csv(summary)), ("json", as_json(summary))):
        table(folder, format=name)
        assert capsys.readouterr().out == expected + "\n"


def test_plot_draws_every_task(folder, capsys):
    plot(folder)
    path = folder / "bowl.png"
    assert capsys.readouterr().out.strip() == str(path)
    assert matplotlib.image.imread(path).std() > 0.01


def test_curves_are_steps_between_quartiles():
    lines = [(np.array([1.0, 4.0]), np.array([1e-1, 1e-3])), (np.array([2.0]), np.array([1e-2]))]
    positions, errors = quartiles(lines)
    assert positions.tolist() == [1.0, 2.0, 4.0]
    # (0.1, 1), (0.1, 0.01), (0.001, 0.01), a quarter, a half and three quarters of the way on a logarithmic axis.
    assert np.allclose(np.log10(errors.T), [[-0.75, -0.5, -0.25], [-1.75, -1.5, -1.25], [-2.75, -2.5, -2.25]])


def test_methods_have_one_style_in_all_figures(folder):
    write(folder, "cobyqa", 0, [1.0, 0.1], each=1)
    (folder / "bowl" / "cobyqa").rename(folder / "quad_cobyqa")
    (folder / "quad").mkdir()
    (folder / "quad_cobyqa").rename(folder / "quad" / "cobyqa")
    chosen = styles_of(load_results(folder))
    assert list(chosen) == ["cobyqa", "gaussian_process", "our_g"]
    assert len({(style["color"], style["linestyle"]) for style in chosen.values()}) == 3


@pytest.fixture
def no_curves(monkeypatch):
    """Curves take most of the time of a page."""
    monkeypatch.setattr("experiments.reports.error_curves.curves", lambda *_: None)


def test_the_page_needs_nothing_else(folder):
    text = page(folder, {"bowl": TASK})
    assert "http" not in text
    assert not re.findall(r"<(?:script|link|iframe)", text)
    sources = re.findall(r"src='([^']*)'", text)
    images = [
        matplotlib.image.imread(io.BytesIO(base64.b64decode(source.removeprefix("data:image/png;base64,"))))
        for source in sources
    ]
    # Curves, the start, the results of run 0 of both methods, the target.
    assert len(images) == 1 + 1 + 2 + 1
    start, result, target = images[1], images[2], images[-1]
    assert np.array_equal(result, target)  # the runs above end at the solution
    pixels = np.round(255 * TASK.picture.of(TASK.start(0)).numpy())
    assert np.array_equal(np.round(255 * start[..., 0]), pixels)
    for part in ("60 1s 100%", "ValueError: no", "gaussian_process", TASK.title, "not shown: 1"):
        assert part in text
    assert "Left out" not in text


def test_pictures_say_how_far_they_are_from_the_target(folder, no_curves):
    text = page(folder, {"bowl": TASK})
    captions = dict(re.findall(r"<figcaption><b>([^<]*)</b><br>([^<]*)</figcaption>", text))
    start, target = TASK.picture.of(TASK.start(0)), TASK.picture.of(TARGET)
    decibels = -10 * math.log10(float((start - target).square().mean()))
    assert captions == {
        "start": f"PSNR {decibels:.1f} dB",  # too small for a window of SSIM
        "our_g": "PSNR inf dB",
        "gaussian_process": "PSNR inf dB",
        "target": "",
    }
    truth = replace(TASK.truth, measures=lambda x: {"distance": float(x[0] - TARGET[0])})
    without = replace(TASK, picture=None, truth=truth)
    text = page(folder, {"bowl": without})
    assert "PSNR" not in text
    assert re.findall(r"<b>([^<]*)</b><br>(distance [^<]*)<", text) == [
        ("start", f"distance {float(TASK.start(0)[0] - TARGET[0]):.3g}"),
        ("gaussian_process", "distance 0"),
        ("our_g", "distance 0"),
    ]


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
    monkeypatch.setattr("experiments.reports.full_setting.time.perf_counter", lambda: clock.now)
    whole = replace(TASK, loss=clock.loss(iter([100, 0.036, 0.7, 0.036, 0.036, 0.001, 0.036]), 1.25))
    task = replace(
        TASK,
        loss=clock.loss(iter([100, 0.003, 0.003, 0.5, 0.003, 0.003, 0.002]), 1.0),
        renderer=Renderer(full=lambda: replace(whole, loss=clock.alone(whole.loss)), release=clock.release),
    )
    return task, clock


def test_saving_is_measured_at_the_same_points_without_the_loading(halved):
    task, clock = halved
    points = line(TARGET + 2, TARGET)
    # The way is 2 sqrt(2) long; losses are its squared length.
    assert torch.allclose(points, TARGET + torch.tensor([2, 1.6, 1.2, 0.8, 0.4, 0]).double()[:, None])
    found = saving(task, points)
    squares = [8 * t**2 for t in (1, 0.8, 0.6, 0.4, 0.2, 0)]
    rms = math.sqrt(sum((0.25 * square) ** 2 for square in squares) / 6)
    assert found == Saving(pytest.approx(0.003), pytest.approx(0.036), pytest.approx(rms / (1.25 * 8)))
    assert clock.calls == 2 * 7
    assert str(found) == ("time saved: 12x (3 ms against 36 ms per evaluation), loss differs by 10 % of its peak")


def test_times_have_units():
    assert "2x (1.5 s against 3 s" in str(Saving(1.5, 3.0, 0.0))
    text = "time saved: 120x (12 us against 1.5 ms per evaluation), loss differs by 140 % of its peak"
    assert str(Saving(1.2e-5, 1.4999e-3, 1.4)) == text


def test_the_report_measures_the_saving_once(folder, halved, no_curves):
    task, clock = halved
    first = page(folder, {"bowl": task})
    assert "12x (3 ms against 36 ms per evaluation)" in first
    assert json.loads((folder / "bowl" / "saving.json").read_text())["full_seconds"] == pytest.approx(0.036)
    calls = clock.calls
    assert page(folder, {"bowl": task}) == first
    assert clock.calls == calls
    assert known_saving(TASK, line(TARGET, TARGET), folder) is None
    assert not (folder / "saving.json").exists()


@pytest.mark.parametrize(
    ("task", "points", "message"),
    [
        (TASK, torch.zeros(1, 2), "task must have a full setting .* bowl has none"),
        (replace(TASK, renderer=Renderer(full=lambda: TASK)), torch.zeros(2), r"points must be \[P, 2\], got \[2\]"),
        (
            replace(TASK, renderer=Renderer(full=lambda: TASK)),
            torch.zeros(0, 2),
            r"points must be \[P, 2\], got \[0, 2\]",
        ),
    ],
)
def test_saving_names_what_is_wrong(task, points, message):
    with pytest.raises(ValueError, match=message):
        saving(task, points)


@pytest.mark.parametrize("shape", [(20, 16), (20, 16, 3)])
def test_measures_of_pictures(shape):
    generator = torch.Generator().manual_seed(0)
    target = torch.rand(shape, generator=generator, dtype=torch.float64)
    picture = (0.8 * target + 0.2 * torch.rand(shape, generator=generator)).clamp(0, 1)
    found = measures(picture, target)
    assert found["PSNR"] == pytest.approx(-10 * math.log10(float((picture - target).square().mean())))
    assert found["SSIM"] == pytest.approx(1 - float(zh.losses.ssim(target)(picture)))
    assert measures(target, target) == {"PSNR": math.inf, "SSIM": pytest.approx(1.0)}
    # What cannot be shown does not count.
    assert measures(picture + (picture == 1), target) == found
    assert measures(picture[:10], target[:10]).keys() == {"PSNR"}
    with pytest.raises(ValueError, match=r"picture must have the shape .*of the target, got \[19, 16"):
        measures(picture[1:], target)


def test_measures_as_text():
    assert described({"PSNR": 31.25, "SSIM": 0.98765, "d": 0.00123}) == "PSNR 31.2 dB, SSIM 0.988, d 0.00123"


def test_report_writes_the_page(folder, tmp_path, no_curves, capsys):
    report(folder)
    assert (folder / "report.html").read_text() == page(folder)
    report(folder, tmp_path / "other.html")
    assert (tmp_path / "other.html").read_text() == page(folder)
    report(folder, tmp_path / "new" / "one" / "page.html")
    assert (tmp_path / "new" / "one" / "page.html").read_text() == page(folder)
    with pytest.raises(SystemExit, match=r"out must be a file, .* got the folder .*new"):
        report(folder, tmp_path / "new")


@pytest.mark.parametrize("command", [table, plot, report])
def test_folders_without_runs_are_refused(command, tmp_path):
    with pytest.raises(SystemExit, match=r"DIR must be a folder .* got .*nowhere"):
        command(tmp_path / "nowhere")
    with pytest.raises(SystemExit, match="has none"):
        command(tmp_path)


@pytest.mark.parametrize("left", ["", '{"task": "bow', "{}", "\0" * 8])
def test_broken_outcomes_are_named(folder, left):
    path = folder / "bowl" / "our_g" / "1.json"
    path.write_text(left)
    with pytest.raises(SystemExit, match=rf"{path} is not the outcome of a run .*delete it"):
        table(folder)


def test_broken_rows_are_named(folder):
    path = folder / "bowl" / "our_g" / "1.jsonl"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join([lines[0], "\0" * 9 + "\n", *lines[2:]]))
    with pytest.raises(SystemExit, match=rf"line 2 of {path} is not a row of a run; delete the file and 1.json"):
        table(folder)


def test_list_names_everything():
    text = listing()
    for name in (*FITTING, *METHODS, "cnn"):
        assert re.search(rf"^{name} ", text, re.MULTILINE), name


def test_list_says_what_is_missing(monkeypatch):
    def load_without(name, *given):
        if name == "quad":
            raise ImportError("task quad needs something", name="something")
        return load(name, *given)

    monkeypatch.setattr("experiments.problems.catalogue.load", load_without)
    assert re.search(r"^quad +task quad needs something$", listing(), re.MULTILINE)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"tasks": ("quat",)}, r"TASK must be some of .* got quat \(did you mean quad\?\)"),
        ({"tasks": ()}, "TASK must be some of .* got none"),
        ({"tasks": ("quad",), "methods": "cma"}, r"methods must be some of .* got cma \(did you mean cma_es"),
        ({"tasks": ("quad",), "runs": 0}, "runs must be at least 1, got 0"),
        ({"tasks": ("quad",), "jobs": -1}, "jobs must be at least 1, got -1"),
        ({"tasks": ("cnn",), "methods": "cma_es"}, "no method of this command can be run on these tasks"),
        ({"tasks": ("quad", "cnn"), "threads": 0}, "threads must be at least 1, got 0"),
        ({"tasks": ("cnn",), "seed": -1}, "seed must be at least 0, got -1"),
        (
            {"tasks": ("quad", "cnn_texture"), "methods": "dfo_ls"},
            "no method of this command can be run on these tasks",
        ),
    ],
)
def test_wrong_arguments_are_named(arguments, message, tmp_path):
    with pytest.raises(SystemExit, match=message):
        run(arguments.pop("tasks"), out=tmp_path, **arguments)


def test_tasks_that_no_method_goes_with_are_left_out(tmp_path, one_process, capsys):
    run(("cnn", "quad"), methods="cobyqa,dfo_ls", runs=1, out=tmp_path)
    printed = capsys.readouterr().out
    for said in (
        "cobyqa is left out on cnn: trains no networks",
        "dfo_ls is left out on cnn: trains no networks",
        "dfo_ls is left out on quad: the black box returns no residuals",
        "1 of 1 runs have ended",
    ):
        assert said in printed
    assert [path.name for path in tmp_path.iterdir() if path.is_dir()] == ["quad"]


def test_networks_and_fits_are_run_by_one_command(tmp_path, capsys, monkeypatch):
    planned = []

    def plan(ensemble, tasks, methods):
        planned.append((ensemble.runs, ensemble.network_runs, ensemble.threads, tasks, methods))
        raise SystemExit("planned")

    monkeypatch.setattr("experiments.ensembles.ensemble.Ensemble.plan", plan)
    for given in ({}, {"runs": 3, "seed": 2, "threads": 4}):
        with pytest.raises(SystemExit, match="planned"):
            run(("quad", "cnn"), methods="our_g", out=tmp_path, **given)
    assert planned == [
        (range(20), range(1), None, ["quad", "cnn"], ["our_g"]),
        (range(2, 5), range(2, 5), 4, ["quad", "cnn"], ["our_g"]),
    ]


def test_a_broken_outcome_is_named_before_anything_is_run(tmp_path, one_process):
    run(("quad",), methods="cobyqa", runs=1, out=tmp_path)
    (tmp_path / "quad" / "cobyqa" / "0.json").write_text("")
    with pytest.raises(SystemExit, match=r"0.json is not the outcome of a run"):
        run(("quad",), methods="cobyqa", runs=2, out=tmp_path)
    assert not (tmp_path / "quad" / "cobyqa" / "1.json").exists()


def test_commands_that_are_printed_can_be_pasted(tmp_path, one_process, capsys):
    out = tmp_path / "two words"
    run(("quad",), methods="cobyqa", runs=1, out=out)
    lines = capsys.readouterr().out.splitlines()
    hints = [shlex.split(line.partition(": ")[2]) for line in lines if "python -m experiments" in line]
    assert hints == [["python", "-m", "experiments", name, str(out)] for name in ("plot", "report")]


def test_run_runs_prints_and_says_how_to_go_on(tmp_path, one_process, no_curves, capsys, monkeypatch):
    run(("quad",), methods="cobyqa, cma_es", runs=2, out=tmp_path, seed=3)
    printed = capsys.readouterr().out
    assert "4 of 4 runs have ended" in printed
    assert as_text(summarize(load_results(tmp_path))) in printed
    for method in ("cobyqa", "cma_es"):
        assert sorted(path.name for path in (tmp_path / "quad" / method).iterdir()) == [
            "3.json",
            "3.jsonl",
            "4.json",
            "4.jsonl",
        ]
    page_of_quad = page(tmp_path)
    assert load("quad").title in page_of_quad

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("experiments.ensembles.ensemble.Ensemble.run", interrupt)
    with pytest.raises(SystemExit, match="the same command goes on"):
        run(("quad",), methods="cobyqa", runs=3, out=tmp_path, seed=3)
