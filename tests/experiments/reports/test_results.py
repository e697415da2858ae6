"""Tables, figures and pages of an ensemble, against numbers computed by hand."""

import csv
import io
import json
import re
from dataclasses import asdict

import pytest
from written_runs import PER_ITERATION, write

from experiments.reports.ensemble_page import report
from experiments.reports.error_curves import plot
from experiments.reports.results import load as load_results
from experiments.reports.summary import as_csv, as_json, as_text, summarize, table
from experiments.runs.records import Files, Outcome, write_outcome


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
    table(folder, methods="all")
    assert capsys.readouterr().out == text + "\n"


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
