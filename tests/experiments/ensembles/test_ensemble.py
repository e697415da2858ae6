"""Ensembles: the order of their jobs, what they refuse, and that neither processes nor a kill change their rows."""

import json
import os
import signal
import time
from dataclasses import replace

import pytest
from endings import ends
from small import (
    BUMP,
    CRASH,
    ELSEWHERE,
    FAIL,
    GATED,
    GATED_BUMP,
    GIVE_UP,
    HALVE,
    MISSING,
    SEARCH,
    SHIFT,
    SIZE,
    TASK,
    run_ensemble,
    search,
)
from written_runs import rows

from experiments.ensembles.ensemble import Ensemble
from experiments.ensembles.provenance import register
from experiments.methods import METHODS
from experiments.runs.attempt import attempt
from experiments.runs.journal import Journal
from experiments.runs.records import Files


def solve(trial):
    return search(trial, {})


def ensemble(folder, runs=2, **changes):
    return Ensemble(folder, range(runs), **changes)


def logs(folder):
    return {str(path.relative_to(folder)): rows(path) for path in sorted(folder.glob("*/*/*.jsonl"))}


@pytest.fixture(scope="module")
def results(tmp_path_factory, fork_workers):
    folder = tmp_path_factory.mktemp("results")
    one = ensemble(folder)
    jobs = one.plan([TASK], [SEARCH, HALVE, FAIL, CRASH, GIVE_UP])
    with pytest.MonkeyPatch.context() as patched:
        fork_workers(patched)
        outcomes = one.run([job for job in jobs if (job.method_name, job.run) != ("crash", 0)])
    return folder, {(o.method, o.run): o for o in outcomes}


@pytest.mark.usefixtures("quick_workers")
def test_results_do_not_depend_on_the_number_of_processes(results, tmp_path):
    two = ensemble(tmp_path, jobs=2)
    outcomes = two.run(two.plan([TASK], [SEARCH, HALVE, FAIL]))
    assert logs(tmp_path).items() <= logs(results[0]).items()
    same = {"seconds": 0, "black_box_seconds": 0, "traceback": None}
    assert len(outcomes) == 6
    for outcome in outcomes:
        assert replace(outcome, **same) == replace(results[1][outcome.method, outcome.run], **same)


def test_results_do_not_depend_on_processes(results, tmp_path):
    for run in range(2):
        attempt(TASK, "search", run, solve, tmp_path)
    assert logs(tmp_path).items() <= logs(results[0]).items()


def test_methods_that_fail_are_outcomes(results):
    reasons = {name: (o.status, o.reason) for (name, run), o in results[1].items() if run == 1}
    assert reasons["fail"] == ("failed", "ZeroDivisionError: as this method")
    assert reasons["crash"] == ("failed", "its process ended with SIGSEGV")
    assert reasons["give_up"] == ("stopped", "the method ended by itself")
    assert reasons["halve"][0] == "finished"


def test_finished_runs_are_not_run_twice(results, capsys):
    before = {path: path.stat().st_mtime_ns for path in results[0].glob("*/*/*.json*")}
    again = ensemble(results[0], runs=2)
    assert len(again.run(again.plan([TASK], [SEARCH, HALVE]))) == 4
    assert {path: path.stat().st_mtime_ns for path in results[0].glob("*/*/*.json*")} == before


def test_jobs_are_task_by_task_and_what_loads_another_scene_comes_last(tmp_path):
    other, derivative = replace(TASK, name="other"), replace(HALVE, name="derivative", another_scene=True)
    jobs = ensemble(tmp_path).plan([TASK, other], [derivative, SEARCH, HALVE])
    one = [("search", 0), ("halve", 0), ("search", 1), ("halve", 1), ("derivative", 0), ("derivative", 1)]
    assert [(job.task_name, job.method_name, job.run) for job in jobs] == [
        (task, *rest) for task in (TASK.name, "other") for rest in one
    ]


def test_other_settings_are_refused(results):
    with pytest.raises(SystemExit, match=r"halve was made with preset = fast \(now paper\), limit = 600.0 \(now 5\)"):
        ensemble(results[0], preset="paper", limit=5).plan([TASK], [HALVE])
    with pytest.raises(SystemExit, match=r"evaluations = 400 \(now 401\)"):
        ensemble(results[0]).plan([replace(TASK, evaluations=401)], [HALVE])


@pytest.mark.parametrize("file", [TASK.name, f"{TASK.name}/halve"])
def test_a_file_in_place_of_a_folder_is_refused_before_the_runs(tmp_path, file):
    path = tmp_path / file
    path.parent.mkdir(exist_ok=True)
    path.touch()
    with pytest.raises(SystemExit, match=rf"^out must be a folder .*, got {tmp_path}/bowl/halve: Not a directory$"):
        ensemble(tmp_path).plan([TASK], [SEARCH, HALVE] if file != TASK.name else [HALVE])
    assert not (tmp_path / "command.json").exists()


@pytest.mark.parametrize("text", ["{", "[]", "{}", '{"commands": 1, "settings": {}}'])
def test_a_note_of_commands_that_cannot_be_read_is_named(tmp_path, text):
    (tmp_path / "command.json").write_text(text)
    with pytest.raises(SystemExit, match=rf"^{tmp_path}/command\.json must have the commands .*; move the folder away"):
        ensemble(tmp_path).plan([TASK], [HALVE])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "paper"}, r"halve was made with preset = fast \(now paper\); delete it"),
        ({"variant": "scalar_rgb"}, r"halve was made with variant = auto \(now scalar_rgb\); delete it"),
    ],
)
def test_one_table_has_one_preset_and_one_renderer(tmp_path, one_process, changes, message):
    one = ensemble(tmp_path)
    one.run(one.plan([TASK], [HALVE]))
    with pytest.raises(SystemExit, match=message):
        ensemble(tmp_path, **changes).plan([TASK], [SEARCH])
    ensemble(tmp_path, limit=5).plan([TASK], [SEARCH])  # a method may have its own time


@pytest.mark.parametrize("counts", [(2, None), (None, 2), (2, 3)])
def test_one_table_has_one_number_of_workers(tmp_path, counts):
    """Seconds are of the clock on the wall with workers, and of the processor without."""
    first, second = ({"preset": "fast"} | ({} if count is None else {"workers": count}) for count in counts)
    register(tmp_path, {"bowl": {"a": first}})
    register(tmp_path, {"bowl": {"a": second}})  # there are no runs yet
    register(tmp_path, {"bowl": {"a": first}})
    (tmp_path / "bowl" / "a").mkdir(parents=True)
    (tmp_path / "bowl" / "a" / "0.json").touch()
    register(tmp_path, {"bowl": {"b": first}, "dish": {"b": second}})
    message = rf"a was made with .*workers = {counts[0]} \(now {counts[1]}\); delete it".replace("None", "none")
    with pytest.raises(SystemExit, match=message):
        register(tmp_path, {"bowl": {"b": second}})


def test_the_folder_says_how_it_was_made(results):
    known = json.loads((results[0] / "command.json").read_text())
    assert known["commands"][0]["command"].startswith("python -m experiments")
    assert known["commands"][0]["machine"].keys() >= {"processor", "cores", "system", "python", "torch"}
    assert known["settings"]["bowl"]["halve"]["level"] == 0.999
    assert results[1]["halve", 0].settings == known["settings"]["bowl"]["halve"]


def test_methods_that_cannot_be_run_are_left_out(tmp_path, capsys):
    jobs = ensemble(tmp_path).plan([TASK], [HALVE, ELSEWHERE, MISSING])
    assert {job.method_name for job in jobs} == {"halve"}
    printed = capsys.readouterr().out
    assert "elsewhere is left out on bowl: not for bowls" in printed
    assert "missing is left out on bowl: needs pip install no-such-package" in printed
    with pytest.raises(SystemExit, match="no method"):
        ensemble(tmp_path).plan([TASK], [ELSEWHERE])


def test_runs_have_numbers_and_come_in_turn(tmp_path):
    jobs = Ensemble(tmp_path, range(5, 8)).plan([TASK], [HALVE, GIVE_UP])
    assert [(job.run, job.method_name) for job in jobs] == [(r, m) for r in (5, 6, 7) for m in ("halve", "give_up")]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"runs": range(0)}, "runs must be at least 1, got 0"),
        ({"runs": range(-1, 2)}, "seed must be at least 0, got -1"),
        ({"runs": range(2), "jobs": 0}, "jobs must be at least 1, got 0"),
        ({"runs": range(2), "limit": 0.0}, "limit must be a positive number of seconds, got 0"),
    ],
)
def test_settings_of_an_ensemble_are_checked(tmp_path, changes, message):
    with pytest.raises(SystemExit, match=message):
        Ensemble(folder=tmp_path, **changes)


@pytest.mark.parametrize(
    ("by", "plans"),
    [(signal.SIGKILL, [(GATED, SEARCH), (GATED_BUMP, "our_g")]), (signal.SIGINT, [(GATED, SEARCH)])],
    ids=["SIGKILL", "SIGINT"],
)
def test_a_killed_ensemble_goes_on(tmp_path, forking, one_process, by, plans):
    """All processes end with the killed process; started again, the ensemble has the rows of an undisturbed one."""
    folder, gate = tmp_path / "out", tmp_path / "gate"
    gate.mkdir()
    killed = forking.Process(target=run_ensemble, args=(folder, gate, plans))
    killed.start()
    while len(waiting := list(gate.iterdir())) < len(plans):  # until all of them wait in the black box
        assert killed.is_alive()
        time.sleep(0.01)
    os.kill(killed.pid, by)
    assert all(ends(int(pid)) for pid in (killed.pid, *(one.name for one in waiting)))
    left = {}
    for task, method in plans:
        files = Files(folder / task.name / getattr(method, "name", method), 0)
        Journal(files.journal).close()  # nobody holds it
        assert not files.outcome.exists()
        left[files] = files.log.read_bytes()
        assert left[files].count(b"\n") > 4
    for (task, method), (files, before) in zip(plans, left.items(), strict=True):
        again = ensemble(folder, 1)
        assert len(again.run(again.plan([task], [method]))) == 1
        assert files.log.read_bytes().startswith(before[: before.rfind(b"\n") + 1])
        known, whole = METHODS.get(method, method), tmp_path / "whole"
        undisturbed = TASK if task is GATED else BUMP
        attempt(undisturbed, known.name, 0, lambda trial, known=known: known(trial, {}), whole)
        expected = rows(Files(whole / undisturbed.name / known.name, 0).log)
        assert [replace(row, task=undisturbed.name) for row in rows(files.log)] == expected
        assert files.weights.exists() == (method == "our_g")


def test_network_tasks_are_run_in_the_same_plan(tmp_path, one_process, capsys):
    one = Ensemble(tmp_path, range(3), network_runs=range(1))
    jobs = one.plan([TASK, BUMP], [HALVE, SHIFT])
    assert [(job.task_name, job.method_name, job.run) for job in jobs] == [
        ("bowl", "halve", 0),
        ("bowl", "halve", 1),
        ("bowl", "halve", 2),
        ("bump", "shift", 0),
    ]
    printed = capsys.readouterr().out
    assert "shift is left out on bowl: trains networks only" in printed
    assert "halve is left out on bump: trains no networks" in printed
    outcomes = one.run(jobs)
    assert [(each.status, each.reason) for each in outcomes[2:]] == [
        ("finished", "both errors reduced by 99.9 %"),
        ("stopped", "evaluations used up"),
    ]
    assert (tmp_path / "bump" / "shift" / "0.pt").exists()


def test_the_last_progress_is_where_the_run_ended(tmp_path, one_process, capsys):
    one = ensemble(tmp_path, 1)
    assert [outcome.status for outcome in one.run(one.plan([TASK], [HALVE]))] == ["finished"]
    log = rows(Files(tmp_path / TASK.name / "halve", 0).log)
    error = 100 * log[-1].image_error / log[0].image_error
    assert error < 0.1
    assert f"bowl halve 0: error {error:.3g} %" in capsys.readouterr().err.rsplit("\r", 1)[-1]


def test_the_first_progress_of_a_network_is_that_of_its_images(tmp_path, one_process, capsys):
    one = Ensemble(tmp_path, range(1))
    one.run(one.plan([type(BUMP)(SIZE)], [SHIFT]))  # none of them is rendered yet
    assert "bump shift 0: 0 of 16 images rendered" in capsys.readouterr().err
