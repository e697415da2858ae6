"""Tables that are stored, and the documents that quote them, against numbers computed by hand."""

import csv
import math
import re
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pytest
from scipy.stats import binomtest

from experiments.ensembles import provenance
from experiments.problems import catalogue
from experiments.problems.tasks import cnn
from experiments.reports import result_files
from experiments.reports.document_tables import SPEED_UP, Query, table_of
from experiments.reports.documents import filled, readme
from experiments.reports.markdown import number
from experiments.reports.networks import HELD_OUT, _remember, held_out
from experiments.reports.speed_ups import speed_ups, with_ratios
from experiments.reports.store import store
from experiments.reports.trained_network import Result
from experiments.runs.records import Files, Log, Outcome, Record, read_outcome, write_outcome
from experiments.studies.bench import bench
from experiments.studies.variance import variance

COMMIT = "0123456789abcdef"


@pytest.fixture(autouse=True)
def results(tmp_path, monkeypatch):
    """An empty folder for stored tables, and code without changes to its commit."""
    monkeypatch.setattr(result_files, "RESULTS", tmp_path / "stored")
    monkeypatch.setattr(provenance, "code", lambda: {"commit": COMMIT, "clean": True})
    own = ["--out", "/home/somebody/a folder", "--jobs=2"]  # of this machine: not to be stored
    monkeypatch.setattr("sys.argv", ["experiments", "run", "bowl", *own, "--limit", "15"])
    return tmp_path / "stored"


def write(folder, task, method, run, errors, *, each, settings=None, status="stopped", x=(1.0, 2.0)):
    """A run with these image errors after `each` evaluations and half a second; parameter errors are their squares."""
    files = Files(folder / task / method, run)
    log = Log(files.log)
    for i, one in enumerate(errors):
        log(Record(task, method, run, i, 0.5 * i, i * each, None, None, one, one**2))
    log.close()
    n = len(errors) - 1
    x = [] if task.startswith("cnn") else list(x)
    one = {"preset": "fast", "limit": 15.0, "evaluations": 400, **(settings or {})}
    write_outcome(Outcome(task, method, run, status, "", 0.5 * n, 0.4 * n, n * each, n, x, one), files)
    provenance.register(folder, {task: {method: one}})


@pytest.fixture
def folder(tmp_path):
    """Evaluations until 99 % of the image error: descent 6 and 9, fr22 30 from one of three starts."""
    folder = tmp_path / "runs"
    write(folder, "bowl", "descent", 3, [100.0, 10.0, 1.0, 0.1], each=3)
    write(folder, "bowl", "descent", 4, [100.0, 50.0, 10.0, 1.0], each=3)
    for run, last in ((3, 0.5), (4, 50.0), (5, 60.0)):
        write(folder, "bowl", "fr22", run, [100.0, last], each=30)
    return folder


def cells(results, name):
    with (results / f"{name}.csv").open() as file:
        return list(csv.DictReader(file))


def rows(results, name):
    """Cells of a stored table, each row with its origin."""
    whence = {one.pop("id"): one for one in cells(results, "origins")}
    return [one | whence[one.pop("origin")] for one in cells(results, name)]


def test_a_measure_of_a_task_has_its_median_and_least_value(tmp_path, results):
    task, ends = catalogue.fitting("meshfit"), []
    for run in range(3):
        x = task.start(run)
        write(tmp_path / "runs", "meshfit", "levels_local", run, [100.0, 1.0], each=9, x=x.tolist())
        ends.append(task.truth.measures(x))
    store(tmp_path / "runs", name="meshes")
    (row, *_) = rows(results, "meshes")
    values = sorted(one["least silhouette IoU"] for one in ends)
    assert row["measure"] == "least silhouette IoU"
    assert float(row["measure_median"]) == pytest.approx(values[1], rel=1e-5)
    assert float(row["measure_least"]) == pytest.approx(values[0], rel=1e-5)


def test_a_row_has_medians_quartiles_shares_and_its_origin(folder, results):
    store(folder, name="bowls")
    there = {(one["method"], one["metric"], one["level"]): one for one in rows(results, "bowls")}
    assert len(there) == 2 * 2 * 3
    ours, theirs = there["descent", "image", "99"], there["fr22", "image", "99"]
    ends = ("", "_low", "_high", "_worst")
    assert [float(ours[f"evaluations{end}"]) for end in ends] == [7.5, 6.75, 8.25, 9.0]
    assert [float(ours[f"seconds{end}"]) for end in ends] == [1.25, 1.125, 1.375, 1.5]
    assert "| 7.5 (at most 9) |" in table_of("bowls", Query.of(["show=evaluations", "worst=show"]))
    assert (ours["reached"], ours["runs"], ours["first_run"], ours["n"]) == ("2", "2", "3", "2")
    assert (ours["preset"], ours["limit"], ours["commit"]) == ("fast", "15", COMMIT)
    assert ours["command"] == "python -m experiments run bowl --limit 15"
    assert ours["machine"]
    assert (theirs["evaluations"], theirs["seconds"], theirs["reached"]) == ("", "", "1")
    interval = binomtest(1, 3).proportion_ci(method="wilson")
    assert float(theirs["share_low"]) == pytest.approx(interval.low, rel=1e-5)
    assert float(theirs["share_high"]) == pytest.approx(interval.high, rel=1e-5)


def test_other_levels_can_be_stored(folder, results):
    store(folder, name="bowls", levels=(0.5, 0.95))
    there = {one["level"]: one for one in rows(results, "bowls") if one["method"] == "descent"}
    assert sorted(there) == ["50", "95"]
    ours = {
        one["level"]: one for one in rows(results, "bowls") if (one["method"], one["metric"]) == ("descent", "image")
    }
    assert [float(ours[level]["evaluations"]) for level in ("50", "95")] == [3.0, 7.5]
    assert "reduced by 50 %" in table_of("bowls", Query.of(["level=50"]))
    with pytest.raises(SystemExit, match=r"levels must be above 0 and at most 0.999, where runs end, got \(1.5,\)"):
        store(folder, name="bowls", levels=(1.5,))


def test_networks_have_a_row_per_method(tmp_path, results):
    folder = tmp_path / "runs"
    for run in range(3):
        write(folder, "cnn", "memory_adam", run, [40.0, 9.0, 2.0], each=10)
    with pytest.raises(SystemExit, match=r"held_out.csv has 0 of 3 runs of memory_adam: call the same `run` again"):
        store(folder, name="networks")
    errors = [((40.0, 2.0), (8.0, 0.02)), ((40.0, 5.0), (8.0, 0.125)), ((40.0, 5.0), (8.0, 0.125))]
    ended = [Result("memory_adam", run, None, None, 1.0, 20, *pair) for run, pair in enumerate(errors)]
    _remember(held_out("cnn", ended[:2]), folder / "cnn" / HELD_OUT)
    _remember(held_out("cnn", ended[1:]), folder / "cnn" / HELD_OUT)
    files = Files(folder / "cnn" / "memory_adam", 2)
    write_outcome(replace(read_outcome(files.outcome), status="failed"), files)
    store(folder, name="networks", failed=True)
    (row,) = rows(results, "networks")
    assert [float(row[one]) for one in ("renders", "seconds")] == [20.0, 1.0]
    assert float(row["parameter_divided"]) == (400 + 64) / 2  # of the two runs that did not fail
    assert float(row["parameter_divided_worst"]) == 64
    assert [float(row[f"parameter_divided_{end}"]) for end in ("low", "high")] == [148, 316]
    assert float(row["image_divided"]) == (20 + 8) / 2
    assert float(row["image_divided_worst"]) == 8
    assert row["measure"] == "rms error [degrees]"
    assert float(row["measure_median"]) == pytest.approx(cnn.DEGREES * math.sqrt((0.02 + 0.125) / 2), rel=1e-5)
    assert float(row["measure_worst"]) == pytest.approx(cnn.DEGREES * math.sqrt(0.125), rel=1e-5)
    assert (row["reached"], row["runs"], row["n"]) == ("1", "3", "")
    text = table_of("networks", Query())
    assert "parameter error divided by | at worst" in text
    assert "1 of 3 (33 %)" in text


def test_networks_have_renders_and_seconds_until_the_parameter_error_is_divided_by_100(tmp_path, results):
    """Parameter errors are squares of the image errors: 1600, and then 16 or less after 20, 10 and 30 renders."""
    folder = tmp_path / "runs"
    logs = {
        "memory_newton": [[40.0, 9.0, 2.0], [40.0, 4.0, 9.0], [40.0, 9.0, 5.0, 2.0]],
        "our_g": [[40.0, 9.0, 9.0], [40.0, 4.0, 2.0], [40.0, 9.0, 5.0]],
        "fr22": [[40.0, 9.0]] * 3,
    }
    for method, runs in logs.items():
        for run, errors in enumerate(runs):
            write(folder, "cnn", method, run, errors, each=10)
        ended = [Result(method, run, None, None, 1.0, 20, (40.0, 2.0), (8.0, 4.0)) for run in range(3)]
        _remember(held_out("cnn", ended), folder / "cnn" / HELD_OUT)
    store(folder, name="networks")
    there = {row["method"]: row for row in rows(results, "networks")}
    names = ("evaluations", "evaluations_worst", "seconds", "seconds_worst", "share")
    ours, theirs, none = ([there[one][f"reduced_{name}"] for name in names] for one in logs)
    assert [float(one) for one in ours] == [20.0, 30.0, 1.0, 1.5, 1.0]
    assert theirs == ["", "", "", "", "0.333333"]
    assert none == ["", "", "", "", "0"]
    text = table_of("networks", Query.of(["titles=hide"]))
    assert "| runs that succeed | until parameter error divided by 100 |" in text
    cells = {line.split(" | ")[1]: line.split(" | ")[-1] for line in text.splitlines()[2:5]}
    assert cells == {"`memory_newton`": "20, 1 s |", "`our_g`": "- (33 %) |", "`fr22`": "- (0 %) |"}
    assert "Last column: renders and seconds until the parameter error is first divided by 100" in text
    alone = table_of("networks", Query.of(["methods=fr22"]))  # nothing to show
    assert "until" not in alone


def another_commit(folder, monkeypatch):
    monkeypatch.setattr(provenance, "code", lambda: {"commit": "fedcba", "clean": True})
    write(folder, "bowl", "our_g", 3, [1.0, 0.1], each=1)


def changed_code(folder, monkeypatch):
    monkeypatch.setattr(provenance, "code", lambda: {"commit": COMMIT, "clean": False})
    write(folder, "bowl", "our_g", 3, [1.0, 0.1], each=1)


def no_commit(folder, monkeypatch):
    monkeypatch.setattr(provenance, "code", lambda: {"commit": None, "clean": None})
    write(folder, "bowl", "our_g", 3, [1.0, 0.1], each=1)


def another_machine(folder, monkeypatch):
    monkeypatch.setattr(provenance, "machine", lambda: {"processor": "abacus", "cores": 10})
    write(folder, "bowl", "our_g", 3, [1.0, 0.1], each=1)


def another_limit(folder, monkeypatch):
    write(folder, "bowl", "our_g", 3, [1.0, 0.1], each=1, settings={"limit": 60.0})


def another_clock(folder, monkeypatch):
    write(folder, "dish", "our_g", 3, [1.0, 0.1], each=1, settings={"workers": 2})


def another_preset(folder, monkeypatch):
    write(folder, "quad", "our_g", 3, [1.0, 0.1], each=1, settings={"preset": "paper"})


def a_network(folder, monkeypatch):
    write(folder, "cnn", "our_g", 3, [1.0, 0.1], each=1)


def an_unfinished_run(folder, monkeypatch):
    Files(folder / "bowl" / "our_g", 3).journal.parent.mkdir()
    Files(folder / "bowl" / "our_g", 3).journal.touch()


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (another_commit, "must be of one commit, got 012345678, fedcba"),
        (changed_code, "code with changes"),
        (no_commit, "must be made in a git repository"),
        (another_machine, "must be made on one machine, got .*abacus, 10 cores"),
        (another_limit, "must have one limit, got 15.0, 60.0"),
        (another_clock, "must have one clock, got processor, wall"),
        (another_preset, "must have one preset, got fast, paper"),
        (a_network, "tasks must all be fitted or all train a network, got bowl, cnn"),
        (an_unfinished_run, "1 runs in .* are unfinished"),
    ],
)
def test_what_does_not_go_together_is_refused(folder, results, monkeypatch, spoil, message):
    spoil(folder, monkeypatch)
    with pytest.raises(SystemExit, match=message):
        store(folder, name="bowls")
    assert not results.exists()


def test_tasks_are_added_to_a_table_of_the_same_protocol(folder, results, tmp_path, monkeypatch):
    more = tmp_path / "more"
    for run in (3, 4, 5):
        write(more, "dish", "fr22", run, [100.0, 0.5], each=2)
    store(folder, name="bowls")
    with pytest.raises(SystemExit, match="must have one runs, got 3, 2"):  # descent has two runs in the first folder
        store(more, name="bowls", add=True)
    write(folder, "bowl", "descent", 5, [100.0, 50.0, 10.0, 1.0], each=3)
    store(folder, name="bowls")
    before = rows(results, "bowls")
    store(more, name="bowls", add=True)
    assert rows(results, "bowls")[: len(before)] == before
    assert [one["task"] for one in rows(results, "bowls")[len(before) :]] == ["dish"] * 6
    store(more, name="bowls", add=True)  # in place of its rows
    assert len(rows(results, "bowls")) == len(before) + 6
    monkeypatch.setattr(provenance, "code", lambda: {"commit": "fedcba", "clean": True})
    other = tmp_path / "other"
    for run in (3, 4, 5):
        write(other, "cup", "fr22", run, [100.0, 0.5], each=2)
    with pytest.raises(SystemExit, match="must have one commit"):
        store(other, name="bowls", add=True)


def test_runs_without_a_limit_go_together(tmp_path, results):
    for task in ("bowl", "dish"):
        write(tmp_path / task, task, "fr22", 3, [100.0, 0.5], each=2, settings={"limit": None})
        store(tmp_path / task, name="bowls", add=task == "dish")
    assert {(one["task"], one["limit"]) for one in rows(results, "bowls")} == {("bowl", ""), ("dish", "")}


def test_a_run_whose_process_died_does_not_hide_the_number_of_parameters(folder, results):
    files = Files(folder / "bowl" / "fr22", 3)
    write_outcome(replace(read_outcome(files.outcome), status="failed", x=[]), files)
    store(folder, name="bowls", failed=True)
    assert {one["n"] for one in rows(results, "bowls")} == {"2"}


def test_runs_that_failed_are_kept_only_if_that_is_asked_for(folder, results, capsys):
    """A run that failed counts among those that did not get there."""
    reason = "FileNotFoundError: No such file or directory: 'mug.ply'"
    for run in (4, 5):
        files = Files(folder / "bowl" / "fr22", run)
        write_outcome(replace(read_outcome(files.outcome), status="failed", reason=reason), files)
    write(folder, "dish", "fr22", 3, [100.0, 0.5], each=2)
    said = f"2 runs in {folder} failed:\n2 of fr22 on bowl: {reason}\n"
    with pytest.raises(SystemExit, match=re.escape(said)):
        store(folder, name="bowls")
    assert not (results / "bowls.csv").exists()
    store(folder, name="dishes", tasks=("dish",))
    assert "fr22 on bowl" not in capsys.readouterr().out
    store(folder, name="bowls", failed=True)
    assert said in capsys.readouterr().out
    kept = {
        (one["task"], one["method"], one["level"]): one for one in rows(results, "bowls") if one["metric"] == "image"
    }
    assert (kept["bowl", "fr22", "99"]["reached"], kept["bowl", "fr22", "99"]["runs"]) == ("1", "3")


@pytest.mark.parametrize(
    ("settings", "clock"),
    [({}, "processor"), ({"threads": 1}, "processor"), ({"threads": None}, "wall"), ({"workers": 1}, "wall")],
)
def test_a_table_says_which_clock_its_seconds_are_of(tmp_path, results, settings, clock):
    write(tmp_path / "runs", "bowl", "our_g", 3, [1.0, 0.1], each=1, settings=settings)
    store(tmp_path / "runs", name="bowls")
    assert {one["clock"] for one in rows(results, "bowls")} == {clock}


def test_some_tasks_of_a_folder(folder, results):
    write(folder, "cnn", "our_g", 3, [1.0, 0.1], each=1, settings={"preset": "paper"})
    store(folder, name="bowls", tasks=("bowl",))
    assert {one["task"] for one in rows(results, "bowls")} == {"bowl"}
    with pytest.raises(SystemExit, match="name must be a word"):
        store(folder, name="../bowls", tasks=("bowl",))


def test_code_is_that_of_the_commit():
    """Outside of the fixture: what git says about this repository."""
    assert re.fullmatch("[0-9a-f]{40}", provenance._git("rev-parse", "HEAD") or "")
    assert provenance._git("no-such-command") is None


def test_a_table_of_fits(folder):
    store(folder, name="bowls")
    lines = table_of("bowls", Query()).splitlines()
    assert lines[0] == "| method | what it does | uses | BOWL, n = 2 |"
    cells = {line.split(" | ")[0].strip("| `"): line.split(" | ")[-1].strip(" |") for line in lines[2:4]}
    assert cells == {"fr22": "- (33 %)", "descent": "7.5, 1.25 s"}
    limits = "A run has at most 400 evaluations. The limit of 15 s ended no run."
    for part in ("2 to 3 starts, numbered from 3. " + limits, "Commit `012345678`", "`python -m experiments run"):
        assert part in lines[-1]
    others = table_of("bowls", Query.of(["level=90", "metric=parameter", "show=evaluations", "methods=fr22"]))
    assert "| 30 (33 %) |" not in others  # one of three is fewer than half
    assert "- (33 %)" in others
    assert "descent" not in others
    assert "- (33 %, 6 to 79 %)" in table_of("bowls", Query.of(["share=interval"]))
    spread = table_of("bowls", Query.of(["quartiles=show"]))
    assert "7.5 [6.75 to 8.25], 1.25 [1.12 to 1.38] s" in spread
    assert "The quartiles stand in brackets after each median." in spread
    short = table_of("bowls", Query.of(["titles=hide", "origin=commit"])).splitlines()
    assert short[0] == "| method | uses | BOWL, n = 2 |"
    assert short[-1].endswith("Seconds are processor time. Commit `012345678`.")
    assert "Seconds are" not in table_of("bowls", Query.of(["show=evaluations"]))


def test_a_table_says_which_runs_the_time_ended(folder, results):
    for run in (3, 4):
        few = {"evaluations": 2000}
        write(folder, "dish", "fr22", run, [100.0, 50.0], each=30, settings=few, status="time limit")
    write(folder, "bowl", "fr22", 5, [100.0, 50.0], each=30, status="time limit")
    store(folder, name="bowls")
    ended = {(one["task"], one["method"]): one["ended_by_time"] for one in rows(results, "bowls")}
    assert ended == {("bowl", "descent"): "0", ("bowl", "fr22"): "1", ("dish", "fr22"): "2"}
    below = table_of("bowls", Query()).splitlines()[-1]
    assert "A run has at most 400 (BOWL) or 2 000 (DISH) evaluations." in below
    assert "The limit of 15 s ended these runs: 1 of `fr22` on BOWL, 2 of `fr22` on DISH." in below


def test_means_of_ratios():
    """Two tasks, one level: ratios of seconds 2 and 8, of evaluations 1 and 4."""
    table = pd.DataFrame(
        [
            ("a", "image", 99, "ours", 10.0, 1.0),
            ("a", "image", 99, "theirs", 10.0, 2.0),
            ("b", "image", 99, "ours", 10.0, 1.0),
            ("b", "image", 99, "theirs", 40.0, 8.0),
            ("c", "image", 99, "ours", float("nan"), float("nan")),
            ("c", "image", 99, "theirs", 5.0, 5.0),
        ],
        columns=["task", "metric", "level", "method", "evaluations", "seconds"],
    )
    theirs, together = speed_ups(with_ratios(table, "ours"), "ours")
    assert (theirs.seconds, theirs.evaluations, theirs.cases) == (5.0, 2.5, 2)
    assert theirs.seconds_geometric == pytest.approx(4.0)
    assert theirs.evaluations_geometric == pytest.approx(2.0)
    assert (theirs.method, together.method, together.seconds) == ("theirs", "all", 5.0)


def test_the_table_of_speed_ups(folder):
    write(folder, "bowl", "cobyqa", 3, [100.0, 0.05], each=15)
    store(folder, name="bowls")
    text = table_of(SPEED_UP, Query.of(["of=bowls", "reference=descent", "methods=cobyqa"]))
    # Evaluations of descent: image 4.5 (of 3 and 6), 7.5, 9 from one of two; parameters 4.5, 4.5, 7.5.
    ratios = [15 / 4.5, 15 / 7.5, 15 / 9, 15 / 4.5, 15 / 4.5, 15 / 7.5]
    cells = [one.strip() for one in text.splitlines()[2].split("|")[1:-1]]
    assert (cells[0], cells[5]) == ("cobyqa", "6")
    assert cells[3] == number(sum(ratios) / 6)
    assert "fr22" not in text


def test_studies_are_kept_as_they_are(results):
    result_files.keep(["problem", "error", "runs"], [["A", 0.123456, 2], ["B", 2000.0, 3]], "study")
    text = table_of("study", Query.of(["columns=problem,error", "problem=B"]))
    assert text.splitlines()[:3] == ["| problem | error |", "| --- | --- |", "| B | 2 000 |"]
    assert "Commit `012345678`" in text


def test_a_study_with_a_column_per_value(results):
    rows = [["A", "m", 8, 0.5], ["A", "m", 32, 0.25], ["A", "n", 8, 3.0], ["B", "n", 8, 2.0], ["B", "o", 8, None]]
    result_files.keep(["problem", "method", "budget", "error"], rows, "study")
    text = table_of("study", Query.of(["across=problem", "rows=method", "show=error"]))
    assert text.splitlines()[:5] == [
        "| method | A | B |",
        "| --- | --- | --- |",
        "| m | 0.5, 0.25 |  |",
        "| n | 3 | 2 |",
        "",
    ]
    assert "Commit `012345678`" in text
    few = table_of("study", Query.of(["across=problem", "rows=method", "show=error", "budget=32"]))
    assert few.splitlines()[2:4] == ["| m | 0.25 |", ""]
    with pytest.raises(SystemExit, match=r"columns are problem, .*got mistake"):
        table_of("study", Query.of(["across=problem", "rows=method", "show=mistake"]))


def test_a_study_is_refused_before_it_measures(results, monkeypatch):
    monkeypatch.setattr(provenance, "code", lambda: {"commit": COMMIT, "clean": False})
    for study, given in ((bench, {"repeats": 10**9}), (variance, {"runs": 10**9})):
        with pytest.raises(SystemExit, match="a stored table must be made by the code of a commit"):
            study(**given, store="study")
        with pytest.raises(SystemExit, match="name must be a word"):
            study(**given, store="a study")


def test_times_of_bench_are_kept(results):
    report = bench(repeats=1, sizes=((2, 2),), memory_n=0, wide=(2,), large=10, remembered=0, store="times")
    there = rows(results, "times")
    assert [row["operation"] for row in there] == [one.operation for one in report.timings]
    assert [float(row["pure torch [us]"]) for row in there] == [round(1e6 * one.torch, 1) for one in report.timings]
    assert there[0]["commit"] == COMMIT


DOCUMENT = """# Title

There are <!-- value: bowls evaluations task=bowl method=descent metric=image level=99 -->?<!-- /value --> of them.

<!-- table: bowls show=evaluations -->
<!-- end -->

`<!-- value: in code -->x<!-- /value -->`

```
<!-- table: in code -->
<!-- end -->
```
"""


def test_documents_are_written_and_checked(folder, tmp_path, capsys):
    store(folder, name="bowls")
    path = tmp_path / "page.md"
    path.write_text(DOCUMENT)
    with pytest.raises(
        SystemExit, match=r"page.md: <!-- table: bowls show=evaluations -->(.|\n)*page.md: <!-- value: bowls"
    ):
        readme((path,), check=True)
    assert path.read_text() == DOCUMENT
    readme((path,))
    text = path.read_text()
    assert "level=99 -->7.5<!-- /value --> of them" in text
    assert table_of("bowls", Query.of(["show=evaluations"])) in text
    assert text.endswith(DOCUMENT[DOCUMENT.index("`<!-- value: in code") :])
    assert filled(text) == text
    readme((path,), check=True)
    path.write_text(text.replace("7.5", "7.4", 1))
    with pytest.raises(SystemExit, match="value: bowls"):
        readme((path,), check=True)
    assert "as it should be" in capsys.readouterr().out
    with pytest.raises(SystemExit, match="FILE must be a Markdown file, got nowhere"):
        readme((Path("nowhere.md"),))


@pytest.mark.parametrize(
    ("mark", "message"),
    [
        ("table: nothing", "table must be one that is stored in .*bowls, got nothing"),
        ("table: bowls level=98", "level must be one of 90, 99, 99.9, got 98"),
        ("table: bowls speed=1", "options that this table does not have: speed"),
        ("table: bowls methods=ours", "methods must be some of fr22, descent, got ours"),
        ("table: bowls level", "options must be name=value, got level"),
        (f"table: {SPEED_UP} reference=fr22", "must have of=NAME"),
        ("value: bowls seconds method=fr22", "must name a column and one row"),
        ("value: bowls speed task=bowl", "must name a column and one row"),
        ("value: bowls seconds taste=sweet", "columns are task, .*got taste"),
        ("value: bowls seconds method=ours", "no row of the table"),
        ("value: bowls seconds n=two", "no row of the table"),
    ],
)
def test_wrong_marks_are_named(folder, mark, message):
    store(folder, name="bowls")
    with pytest.raises(SystemExit, match=message):
        filled(f"<!-- {mark} -->\n<!-- end -->\n<!-- /value -->")
