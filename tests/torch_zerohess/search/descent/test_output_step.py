"""What a descent learns from a step's output, case by case: outputs of a known misfit, and the rule for each."""

import math
from dataclasses import replace

import pytest
import torch
from searches import zeros

from torch_zerohess.search.descent.output_step import after_output
from torch_zerohess.search.descent.progress import DescentProgress
from torch_zerohess.search.protocol.state import Best
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel
from truths import vector

N = 16
END, BEST = torch.ones(N, dtype=torch.float64), 2 * torch.ones(N, dtype=torch.float64)


def step(*, length=0.4, rank=N, smoothed=1.0, **known):
    """A step of the length, from a loss of 10, whose model predicts that the output changes from (0, 0) to (1, 0)."""
    s = torch.zeros(rank, dtype=torch.float64)
    s[0] = length * math.sqrt(N)
    jacobian = torch.zeros(rank, 2, dtype=torch.float64)
    jacobian[0, 0] = 1.0 / s[0]
    basis = None if rank == N else torch.eye(N, dtype=torch.float64)[:, :rank]
    hessian, errors = torch.zeros(rank, rank, dtype=torch.float64), (zeros(rank), zeros(rank))
    model = LocalModel(smoothed, zeros(rank), hessian, basis, *errors, intercept=zeros(2), jacobian=jacobian)
    settings = {"value": 10.0, "lowest": Best(BEST, 10.0), "model": model, "step": s, "phase": "trial", **known}
    return DescentProgress(best=Best(BEST, 10.0), center=zeros(N), pool=Pool.empty(N), **settings)


def after(known, *, misfit, loss):
    """What is known after an output whose squared error is `misfit` times the squared change, and its loss."""
    return after_output(known, END, loss, vector(1.0, math.sqrt(misfit)))


@pytest.mark.parametrize(("length", "narrowing"), [(0.0001, 0.85), (0.4, 0.97), (0.9, 1.05)])
@pytest.mark.parametrize(("misfit", "faithful"), [(0.24, True), (0.26, False), (4.9, False)])
def test_a_step_that_lowers_the_loss_asks_for_no_samples(misfit, faithful, length, narrowing):
    """The better its output was predicted, the less sigma shrinks: the length of the step says how much."""
    now = after(step(length=length, misled=3, retries=1, reach=0.3), misfit=misfit, loss=9.0)
    assert torch.equal(now.center, END)
    assert (now.value, now.phase, now.faithful, now.misled, now.retries, now.reach) == (9.0, "trial", True, 0, 0, 1.0)
    assert now.sigma == pytest.approx(1.0 if faithful else narrowing, abs=1e-4)


@pytest.mark.parametrize(("length", "before", "sigma"), [(0.91, 0.5, 0.75), (0.89, 0.5, 0.5), (0.91, 1.5, 1.6)])
def test_a_long_step_of_a_faithful_model_widens_sigma(length, before, sigma):
    assert after(step(length=length, sigma=before), misfit=0.24, loss=9.0).sigma == pytest.approx(sigma)


@pytest.mark.parametrize(("misfit", "phase"), [(0.24, "sample"), (0.26, "trial")])
def test_a_faithful_model_gets_samples_where_it_knows_nothing(misfit, phase):
    now = after(step(rank=N - 3), misfit=misfit, loss=9.0)
    assert now.phase == phase
    if phase == "sample":
        assert (now.need, now.paired) == (3, False)


@pytest.mark.parametrize(("misfit", "loss"), [(5.1, 9.0), (0.3, 9.85), (0.3, 10.0), (0.3, 20.0)])
def test_otherwise_it_moves_and_samples(misfit, loss):
    now = after(step(), misfit=misfit, loss=loss)
    assert torch.equal(now.center, END)
    assert (now.value, now.phase, now.faithful) == (loss, "sample", False)


@pytest.mark.parametrize(("misfit", "loss", "faithful"), [(0.24, 9.9, True), (0.26, 9.9, False), (0.24, 10.1, False)])
def test_a_small_gain_that_was_predicted_keeps_the_faith(misfit, loss, faithful):
    assert after(step(), misfit=misfit, loss=loss).faithful == faithful


def test_a_model_that_misleads_gets_more_samples_every_time():
    known, needs, counts = step(), [], []
    for misfit in (3.0, 3.0, 3.0, 3.0, 3.0, 1.0, 3.0, 0.2, 3.0):
        known = after(replace(known, phase="trial"), misfit=misfit, loss=20.0)
        needs.append(known.need)
        counts.append(known.misled)
    assert counts == [1, 2, 3, 4, 5, 5, 6, 0, 1]
    assert needs == [2, 4, 8, 16, 16, 4, 16, 4, 2]  # at most n, n / 4 where it does not mislead


def test_a_faithful_model_is_tried_again_with_shorter_steps():
    known = step(faithful=True, length=0.5)
    for retries in (1, 2):
        known = after(known, misfit=0.1, loss=10.0)
        assert torch.equal(known.center, zeros(N))
        assert (known.value, known.phase, known.retries) == (10.0, "trial", retries)
        assert known.reach == pytest.approx(0.2)
        assert known.sigma == pytest.approx(0.9**retries)
    known = after(known, misfit=0.1, loss=10.0)
    assert torch.equal(known.center, END)
    assert (known.phase, known.reach, known.retries) == ("sample", 1.0, 0)


@pytest.mark.parametrize(("smoothed", "stalled"), [(0.96, True), (0.94, False)])
def test_sigma_shrinks_faster_where_the_smoothed_loss_has_stalled(smoothed, stalled):
    """Of the eight latest steps none is a twentieth lower than the lowest one before them."""
    known, factors = step(length=0.4, smoothed=1.0, patience=4), []
    for k in range(12):
        known = replace(known, model=replace(known.model, value=1.0 if k < 4 else smoothed), phase="trial")
        before = known.sigma
        known = after(known, misfit=1.0, loss=20.0)
        factors.append(known.sigma / before)
    expected = [0.97] * 8 + [0.97 * 0.8 if stalled else 0.97] * 4
    assert factors == pytest.approx(expected)


@pytest.mark.parametrize(
    ("loss", "misfit", "patience", "factor"),
    [
        (10.2, 0.3, 0, 1.3),
        (10.2, 0.3, 3, 1.3),
        (10.2, 0.3, 4, 0.97),  # long enough
        (10.4, 0.3, 0, 0.97),  # not flat
        (10.2, 0.2, 0, 0.97),  # flat, and predicted to be
    ],
)
def test_on_a_plateau_sigma_grows_for_a_while(loss, misfit, patience, factor):
    now = after(step(patience=patience), misfit=misfit, loss=loss)
    assert now.sigma == pytest.approx(factor)
    assert now.patience == patience + (factor > 1)
    assert torch.equal(now.center, END)
    wide = after(step(patience=patience, sigma=1.5), misfit=misfit, loss=loss)
    assert wide.sigma == pytest.approx(1.5 * min(factor, 1.6 / 1.5))


@pytest.mark.parametrize(("lowest", "returns"), [(8.9, True), (9.1, False)])
def test_from_a_plateau_it_returns_to_a_better_point(lowest, returns):
    now = after(step(lowest=Best(BEST, lowest)), misfit=0.3, loss=10.0)
    assert torch.equal(now.center, BEST if returns else END)
    assert now.value == (lowest if returns else 10.0)
    assert now.sigma == pytest.approx(0.97 if returns else 1.3)
