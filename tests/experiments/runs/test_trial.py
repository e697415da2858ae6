"""Runs of fitting tasks: counts, logs, how runs end, and that a kill changes nothing."""

import importlib.util
import os
import random
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small import FAIL, GIVE_UP, HALVE, TARGET, TASK, search
from written_runs import rows

from experiments.runs import journal
from experiments.runs.attempt import attempt
from experiments.runs.base_trial import Finished
from experiments.runs.journal import BusyError, Journal
from experiments.runs.records import Files, read, read_outcome
from experiments.runs.trial import Trial


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


class Clock:
    """Seconds of the processor and of the wall that pass only when someone says so."""

    def __init__(self, monkeypatch):
        self.now = self.wall = 0.0
        monkeypatch.setattr("experiments.runs.recorder.time.process_time", lambda: self.now)
        monkeypatch.setattr("experiments.runs.recorder.time.perf_counter", lambda: self.wall)

    def slow(self, seconds, fn, wall=0.0):
        """Return the function, which takes so many seconds of the processor, and of the wall."""

        def wait(x):
            self.now += seconds
            self.wall += wall
            return fn(x)

        return wait


def test_time_for_errors_is_not_counted(monkeypatch):
    clock = Clock(monkeypatch)
    truth = replace(TASK.truth, image_error=clock.slow(100.0, TASK.truth.image_error))
    trial = Trial(replace(TASK, loss=clock.slow(0.5, TASK.loss), truth=truth), "any", 0)
    for _ in range(3):
        trial.loss(torch.zeros(1, 2))
        clock.now += 0.25  # of the method
        trial.report(trial.start)
    assert [row.seconds for row in trial.rows] == [0.0, 0.75, 1.5, 2.25]
    assert (trial.seconds, trial.black_box_seconds) == (2.25, 1.5)


@pytest.mark.parametrize(("parallel", "seconds"), [(False, 0.5), (True, 20.0)])
def test_which_clock_counts(monkeypatch, parallel, seconds):
    """Waiting counts where the black box works in other processes meanwhile, and not where other programs do."""
    clock = Clock(monkeypatch)
    slow = replace(TASK, loss=clock.slow(0.5, TASK.loss, wall=20.0))
    trial = Trial(slow, "any", 0, parallel=parallel)
    trial.loss(torch.zeros(1, 2))
    trial.report(trial.start)
    assert trial.rows[-1].seconds == trial.black_box_seconds == trial.seconds == seconds
    outcome = attempt(slow, "any", 0, lambda one: one.loss(one.start[None]), parallel=parallel)
    assert outcome.seconds == outcome.black_box_seconds == seconds


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


def test_time_limit(monkeypatch):
    clock = Clock(monkeypatch)
    slow = replace(
        TASK,
        loss=clock.slow(0.2, TASK.loss),
        output=replace(TASK.output, image=clock.slow(0.2, TASK.output.image)),
    )
    outcome = attempt(slow, "search", 0, solve, limit=0.5)
    assert (outcome.status, outcome.reason) == ("time limit", "more than 0.5 s")
    assert outcome.seconds == outcome.black_box_seconds == pytest.approx(0.6)


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


def test_without_locks_a_journal_is_replayed_and_deleted(tmp_path, monkeypatch):
    """As on a system that has no fcntl."""
    monkeypatch.setitem(sys.modules, "fcntl", None)
    spec = importlib.util.spec_from_file_location("journal_without_locks", journal.__file__)
    other = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, other)  # dataclasses look there
    spec.loader.exec_module(other)
    path, points = tmp_path / "a.journal", torch.tensor([[1.0, 2.0]])
    one = other.Journal(path)
    assert one.replay(points) is None
    one.append(points, torch.tensor([3.0]), 0.5, 0.25)
    again = other.Journal(path)  # nobody keeps a second one out
    entry = again.replay(points)
    assert (entry.values.tolist(), entry.seconds, entry.black_box_seconds) == ([3.0], 0.5, 0.25)
    third = other.Journal(path)
    with pytest.raises(other.DivergedError):
        third.replay(points + 1)
    third.close()
    one.close()
    again.delete()
    assert not path.exists()
    with pytest.raises(ValueError, match="closed"):
        again.append(points, torch.tensor([3.0]), 0.5, 0.25)
