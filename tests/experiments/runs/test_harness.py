"""Runs of the harness: what is counted and logged, how they end, and that a kill changes nothing."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch
from small import CRASH, ELSEWHERE, FAIL, GIVE_UP, HALVE, MISSING, SEARCH, SLOW, TARGET, TASK, search

from experiments.ensembles.ensemble import Ensemble
from experiments.runs.journal import BusyError, Journal
from experiments.runs.records import Files, read, read_outcome
from experiments.runs.trial import Finished, Trial, attempt


def rows(path):
    """Records of a log without their times."""
    return [replace(record, seconds=0.0) for record in read(path)]


def solve(trial):
    return search(trial, {})


def test_evaluations_are_counted_and_limited():
    trial = Trial(replace(TASK, evaluations=10), "any", 3)
    assert torch.equal(trial.start, TASK.start(3))
    points = torch.zeros(4, 2).double()
    assert trial.loss(points).tolist() == [5.0] * 4
    assert trial.image(points).shape == (4, 2, 3)
    assert (trial.evaluations, trial.remaining) == (8, 2)
    with pytest.raises(Finished, match="evaluations used up"):
        trial.loss(points[:3])
    assert trial.evaluations == 8
    with pytest.raises(Finished, match="evaluations used up"):  # the end is final
        trial.loss(points[:1])


def test_rows_have_errors_that_cost_nothing():
    trial = Trial(TASK, "any", 0)
    trial.loss(torch.zeros(1, 2))
    trial.report(trial.start - 0.5, sigma=torch.tensor(2.0), loss=float("nan"))
    first, second = trial.rows
    assert (first.iteration, first.evaluations, first.seconds, first.sigma) == (0, 0, 0.0, None)
    assert first.image_error == float(TASK.loss(trial.start[None])[0])
    assert (second.iteration, second.evaluations, second.sigma, second.loss) == (1, 1, 2.0, None)
    assert second.parameter_error == pytest.approx(float((trial.start - 0.5 - TARGET).square().sum()))


def test_time_for_errors_is_not_counted():
    def slow(x):
        time.sleep(0.05)
        return 1.0

    trial = Trial(replace(TASK, truth=replace(TASK.truth, image_error=slow)), "any", 0)
    for _ in range(4):
        trial.loss(torch.zeros(1, 2))
        trial.report(trial.start)
    assert trial.seconds < 0.05
    assert [a.seconds < b.seconds for a, b in zip(trial.rows, trial.rows[1:], strict=False)] == [True] * 4


@pytest.mark.parametrize("points", [torch.zeros(2), torch.zeros(4, 3)])
def test_wrong_shapes_are_named(points):
    trial = Trial(TASK, "any", 0)
    with pytest.raises(ValueError, match=r"\[K, 2\]"):
        trial.loss(points)
    with pytest.raises(ValueError, match=r"\[2\]"):
        trial.report(torch.zeros(3))
    with pytest.raises(ValueError, match="returns a loss only"):
        Trial(replace(TASK, output=None), "any", 0).image(torch.zeros(1, 2))


def swallow(trial):
    """What a library may do to exceptions of the function that it minimises."""
    for _ in range(10_000):
        try:
            trial.loss(trial.start[None])
            trial.report(trial.start)
        except Exception:  # noqa: PERF203
            pass


@pytest.mark.parametrize(
    ("method", "status", "reason", "evaluations"),
    [
        (lambda t: HALVE.solve(t, {}), "finished", "both errors reduced by 99.9 %", 10),  # 4^-5 < 1e-3
        (lambda t: GIVE_UP.solve(t, {}), "stopped", "the method ended by itself", 1),
        (lambda t: FAIL.solve(t, {}), "failed", "ZeroDivisionError: as this method", 1),
        (lambda t: sys.exit("no"), "failed", "SystemExit: no", 0),
        (swallow, "stopped", "evaluations used up", 400),
    ],
)
def test_how_runs_end(tmp_path, method, status, reason, evaluations):
    outcome = attempt(TASK, "any", 0, method, tmp_path, settings={"a": 1})
    files = Files(tmp_path / "bowl" / "any", 0)
    assert (outcome.status, outcome.reason, outcome.evaluations) == (status, reason, evaluations)
    assert read_outcome(files.outcome) == outcome
    assert outcome.settings == {"a": 1}
    assert outcome.iterations == len(rows(files.log)) - 1
    assert not files.journal.exists()
    assert (outcome.traceback is None) == (status != "failed")


def test_precision_asks_for_more():
    precise = replace(TASK, truth=replace(TASK.truth, precision=1e-6))
    outcome = attempt(precise, "halve", 0, lambda t: HALVE.solve(t, {}))
    distance = float((torch.tensor(outcome.x) - TARGET).square().sum())
    assert outcome.status == "finished"
    assert 1e-6 / 4 < distance <= 1e-6


def test_time_limit():
    outcome = attempt(SLOW, "search", 0, solve, limit=0.25)
    assert (outcome.status, outcome.reason) == ("time limit", "more than 0.25 s")
    assert 0.25 < outcome.seconds < 1
    assert 0.3 < outcome.black_box_seconds < outcome.seconds


class Snapshots:
    """Copies of log and journal after every row of an uninterrupted run."""

    def __init__(self, folder: Path) -> None:
        self.files = Files(folder / "bowl" / "search", 0)
        self.taken: list[tuple[bytes, bytes]] = []
        self.calls = 0
        attempt(self.task(), "search", 0, solve, folder, watch=self.take)
        self.rows, self.outcome = rows(self.files.log), read_outcome(self.files.outcome)

    def take(self, record):
        self.taken.append((self.files.log.read_bytes(), self.files.journal.read_bytes()))

    def task(self):
        def counted(x):
            self.calls += len(x)
            return TASK.loss(x)

        def counted_image(x):
            self.calls += len(x)
            return TASK.output.image(x)

        return replace(TASK, loss=counted, output=replace(TASK.output, image=counted_image))

    def resume(self, log: bytes, journal: bytes, folder: Path) -> int:
        """Go on from files that a kill has left, compare with the uninterrupted run, return the calls it took."""
        files = Files(folder / "bowl" / "search", 0)
        files.folder.mkdir(parents=True, exist_ok=True)
        files.log.write_bytes(log)
        files.journal.write_bytes(journal)
        self.calls = 0
        outcome = attempt(self.task(), "search", 0, solve, folder)
        assert rows(files.log) == self.rows
        kept = log[: log.rfind(b"\n") + 1]
        assert files.log.read_bytes().startswith(kept)
        seconds = [record.seconds for record in read(files.log)]
        assert seconds == sorted(seconds)
        assert (outcome.x, outcome.evaluations, outcome.reason) == (
            self.outcome.x,
            self.outcome.evaluations,
            self.outcome.reason,
        )
        return self.calls


def test_a_run_goes_on_from_whatever_a_kill_left(tmp_path):
    whole = Snapshots(tmp_path / "whole")
    assert len(whole.rows) > 20
    assert whole.calls == whole.outcome.evaluations
    draw = random.Random(0)
    for trial in range(60):
        log, journal = draw.choice(whole.taken)
        if trial % 3:  # a cut last line, a cut last batch; the log may even be ahead of the journal
            journal = journal[: draw.randrange(len(journal) + 1)]
        if trial % 2:
            log = log[: draw.randrange(len(log) + 1)]
        whole.resume(log, journal, tmp_path / str(trial))


def test_a_run_goes_on_from_what_a_power_cut_left(tmp_path):
    """Blocks that never reached the disk are zeros, wherever they are."""
    whole = Snapshots(tmp_path / "whole")
    log, journal = whole.taken[-1]
    draw = random.Random(1)
    for trial in range(20):
        first, second = draw.randrange(len(log)), draw.randrange(len(journal))
        zeros = [
            content[:at] + bytes(len(content[at : at + 400])) + content[at + 400 :]
            for content, at in ((log, first), (journal, second))
        ]
        files = Files(tmp_path / str(trial) / "bowl" / "search", 0)
        files.folder.mkdir(parents=True)
        files.log.write_bytes(zeros[0])
        files.journal.write_bytes(zeros[1])
        outcome = attempt(whole.task(), "search", 0, solve, tmp_path / str(trial))
        assert rows(files.log) == whole.rows
        assert (outcome.x, outcome.evaluations) == (whole.outcome.x, whole.outcome.evaluations)


def test_what_a_run_leaves_is_on_the_disk_before_its_outcome_has_its_name(tmp_path, monkeypatch):
    events, sync, move = [], os.fsync, os.replace
    monkeypatch.setattr(os, "fsync", lambda file: (events.append(os.fstat(file).st_ino), sync(file)))
    monkeypatch.setattr(os, "replace", lambda part, path: (events.append(path.name), move(part, path)))
    attempt(TASK, "halve", 0, lambda t: HALVE.solve(t, {}), tmp_path)
    files = Files(tmp_path / "bowl" / "halve", 0)
    assert events == [files.log.stat().st_ino, files.outcome.stat().st_ino, "0.json"]


def test_a_replay_calls_no_black_box(tmp_path):
    whole = Snapshots(tmp_path / "whole")
    log, journal = whole.taken[-1]
    assert whole.resume(log, journal, tmp_path / "end") == 0
    log, journal = whole.taken[10]
    assert whole.resume(log, journal, tmp_path / "middle") == whole.outcome.evaluations - whole.rows[10].evaluations


def test_a_journal_of_other_code_is_thrown_away(tmp_path):
    whole = Snapshots(tmp_path / "whole")
    log, journal = whole.taken[12]
    files = Files(tmp_path / "new" / "bowl" / "halve", 0)
    files.folder.mkdir(parents=True)
    files.log.write_bytes(log)
    files.journal.write_bytes(journal)
    outcome = attempt(TASK, "halve", 0, lambda t: HALVE.solve(t, {}), tmp_path / "new")
    assert outcome.status == "finished"
    assert [row.evaluations for row in rows(files.log)] == [0, 2, 4, 6, 8, 10]
    assert {row.method for row in rows(files.log)} == {"halve"}


def test_a_journal_is_written_by_one_process(tmp_path):
    journal = Journal(tmp_path / "a.journal")
    with pytest.raises(BusyError, match="another process"):
        Journal(tmp_path / "a.journal")
    journal.close()
    Journal(tmp_path / "a.journal").delete()


def ensemble(folder, runs=2, **changes):
    return Ensemble(folder, range(runs), **changes)


def logs(folder):
    return {str(path.relative_to(folder)): rows(path) for path in sorted(folder.glob("*/*/*.jsonl"))}


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("results")
    one = ensemble(folder)
    outcomes = one.run(one.plan([TASK], [SEARCH, HALVE, FAIL, CRASH, GIVE_UP]))
    return folder, {(o.method, o.run): o for o in outcomes}


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


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"preset": "paper"}, r"halve was made with preset = fast \(now paper\); delete it"),
        ({"variant": "scalar_rgb"}, r"halve was made with variant = auto \(now scalar_rgb\); delete it"),
    ],
)
def test_one_table_has_one_preset_and_one_renderer(tmp_path, changes, message):
    one = ensemble(tmp_path)
    one.run(one.plan([TASK], [HALVE]))
    with pytest.raises(SystemExit, match=message):
        ensemble(tmp_path, **changes).plan([TASK], [SEARCH])
    ensemble(tmp_path, limit=5).plan([TASK], [SEARCH])  # a method may have its own time


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


ENSEMBLE = """
import sys
from pathlib import Path
from small import SEARCH, SLOW
from experiments.ensembles.ensemble import Ensemble

if __name__ == "__main__":
    ensemble = Ensemble(Path(sys.argv[1]), range(2), jobs=2)
    print(len(ensemble.run(ensemble.plan([SLOW], [SEARCH]))))
"""


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGINT])
def test_a_killed_ensemble_goes_on(tmp_path, by):
    """All processes end with the one that is killed, and starting it again gives the rows of one that was not."""
    root = Path(__file__).parents[3]
    script, folder = tmp_path / "script.py", tmp_path / "out"
    script.write_text(f"import sys\nsys.path[:0] = [{str(root)!r}, {str(root / 'tests')!r}]\n{ENSEMBLE}")
    command = [sys.executable, str(script), str(folder)]
    killed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    files = [Files(folder / "slow" / "search", run) for run in range(2)]
    until = time.monotonic() + 60
    while not any(one.log.exists() and len(rows(one.log)) > 8 for one in files):
        assert killed.poll() is None
        assert time.monotonic() < until
        time.sleep(0.01)
    killed.send_signal(by)
    killed.wait(20)
    time.sleep(1.0)
    files = [one for one in files if one.log.exists()]
    for one in files:  # the workers have ended: nobody holds the journals
        Journal(one.journal).close()
        assert not one.outcome.exists()
    left = [one.log.read_bytes() for one in files]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "2"
    for one, before in zip(files, left, strict=True):
        assert one.log.read_bytes().startswith(before[: before.rfind(b"\n") + 1])
        whole = Trial(TASK, "search", one.run)
        torch.manual_seed(whole.seed)
        with pytest.raises(Finished):
            solve(whole)
        expected = [asdict(replace(record, task="slow", seconds=0.0)) for record in whole.rows]
        assert [asdict(record) for record in rows(one.log)] == expected
