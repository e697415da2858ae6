"""Runs of network tasks: counts, logs, how runs end, their weights, and that a kill changes nothing."""

import math

import pytest
import torch
from small import BUMP, FAIL_TO_TRAIN, SHIFT, SIZE, Bump
from written_runs import rows

from experiments.methods import METHODS
from experiments.runs.attempt import attempt
from experiments.runs.base_trial import Finished
from experiments.runs.network_trial import NetworkTrial
from experiments.runs.records import Files

METHOD_NAMES = ["our_g", "our_hvpa", "shift"]


def method(name):
    return SHIFT if name == "shift" else METHODS[name]


class Counted(Bump):
    """Counts all points that are rendered, and the calls of the loss; it is interrupted after some of them."""

    def __init__(self, most=math.inf):
        super().__init__(SIZE)
        self.most, self.calls, self.points = most, 0, 0

    def image(self, x):
        self.points += len(x)
        return super().image(x)

    def loss(self, x, images):
        if self.calls == self.most:
            raise KeyboardInterrupt
        self.calls += 1
        return super().loss(x, images)


def test_evaluations_are_counted_and_limited():
    task = Counted()
    trial = NetworkTrial(task, "any", 0)
    images, x = task.training(0)
    assert torch.equal(trial.images, images)
    rendered = task.points
    assert rendered == SIZE.images + 2 * SIZE.held_out  # and the image error of the first row
    assert trial.loss(x, images).tolist() == [0.0] * 12
    wrong = trial.image(x + 1.0)
    torch.testing.assert_close(trial.loss(x + 1.0, images), (wrong - images).square().mean((1, 2, 3)))
    assert (trial.evaluations, trial.remaining) == (36, SIZE.evaluations - 36)
    assert task.points - rendered == trial.evaluations
    for _ in range(4):
        trial.image(x)
    assert trial.remaining == 0
    for _ in range(2):  # the end is final
        with pytest.raises(Finished, match="evaluations used up"):
            trial.image(x[:1])


def test_rows_have_errors_of_the_held_out_images():
    trial = NetworkTrial(BUMP, "any", 3)
    encoder, start = BUMP.encoders(3)
    assert all(torch.equal(a, b) for a, b in zip(trial.encoder.parameters(), start.parameters(), strict=True))
    before = BUMP.image_error(encoder), BUMP.parameter_error(encoder)
    with torch.no_grad():
        trial.encoder.layers[-2].bias += 1.0
    trial.report(sigma=torch.tensor(2.0), loss=3.0, image_error=0.5)
    trial.report(measured=True)
    trial.report()
    after = BUMP.image_error(trial.encoder), BUMP.parameter_error(trial.encoder)
    assert after[1] != before[1]
    assert [(row.image_error, row.parameter_error) for row in trial.rows] == [
        before,
        (0.5, after[1]),
        after,
        (None, after[1]),
    ]
    assert [(row.iteration, row.sigma, row.loss) for row in trial.rows[:2]] == [(0, None, None), (1, 2.0, 3.0)]
    assert trial.evaluations == 0


@pytest.mark.parametrize(("threads", "clock"), [(None, "perf_counter"), (2, "perf_counter"), (1, "process_time")])
def test_time_limit(monkeypatch, threads, clock):
    now = 0.0
    monkeypatch.setattr(f"experiments.runs.recorder.time.{clock}", lambda: now)
    monkeypatch.setattr(BUMP, "threads", threads)
    trial = NetworkTrial(BUMP, "any", 0, limit=5.0)
    trial.report()
    now = 6.0
    with pytest.raises(Finished, match="more than 5 s"):
        trial.report()


def test_the_outcome_has_the_weights_beside_it(tmp_path):
    seen = []
    outcome = attempt(BUMP, "shift", 1, lambda trial: (seen.append(trial), SHIFT(trial, {})), tmp_path)
    assert (outcome.status, outcome.reason, outcome.evaluations) == ("stopped", "evaluations used up", 84)
    files = Files(tmp_path / "bump" / "shift", 1)
    weights = torch.load(files.weights, weights_only=True)
    trained, start = seen[0].encoder.state_dict(), BUMP.encoders(1)[1].state_dict()
    assert all(torch.equal(weights[name], trained[name]) for name in trained)
    assert not torch.equal(weights["layers.12.bias"], start["layers.12.bias"])
    assert not files.journal.exists()


def test_a_method_that_fails_leaves_no_weights(tmp_path):
    outcome = attempt(BUMP, "fail_to_train", 0, lambda trial: FAIL_TO_TRAIN(trial, {}), tmp_path)
    assert (outcome.status, outcome.reason) == ("failed", "ZeroDivisionError: as this method does")
    assert not Files(tmp_path / "bump" / "fail_to_train", 0).weights.exists()


@pytest.mark.parametrize("name", METHOD_NAMES)
@pytest.mark.parametrize("calls", [0, 1, 3])
def test_an_interrupted_run_goes_on_with_the_same_rows(tmp_path, name, calls):
    def run(task, folder):
        return attempt(task, name, 2, lambda trial: method(name)(trial, {}), tmp_path / folder)

    uninterrupted = Counted()
    whole = run(uninterrupted, "whole")
    with pytest.raises(KeyboardInterrupt):
        run(Counted(calls), "killed")
    expected, files = (Files(tmp_path / folder / "bump" / name, 2) for folder in ("whole", "killed"))
    before = files.log.read_bytes()
    assert before.count(b"\n") == 1 + calls  # a row per call
    task = Counted()
    outcome = run(task, "killed")
    assert files.log.read_bytes().startswith(before)
    assert rows(files.log) == rows(expected.log)
    assert outcome.evaluations == whole.evaluations
    assert task.calls == uninterrupted.calls - calls
    weights, others = (torch.load(one.weights, weights_only=True) for one in (files, expected))
    assert all(torch.equal(weights[layer], others[layer]) for layer in others)


def test_a_log_of_other_code_is_thrown_away(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        attempt(Counted(3), "one", 0, lambda trial: METHODS["our_g"](trial, {}), tmp_path)
    outcome = attempt(BUMP, "one", 0, lambda trial: SHIFT(trial, {}), tmp_path)
    whole = attempt(BUMP, "one", 0, lambda trial: SHIFT(trial, {}), tmp_path / "whole")
    assert outcome.evaluations == whole.evaluations == 84
    assert rows(Files(tmp_path / "bump" / "one", 0).log) == rows(Files(tmp_path / "whole" / "bump" / "one", 0).log)
