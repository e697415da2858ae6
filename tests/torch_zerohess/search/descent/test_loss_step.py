"""What a descent learns from a step's loss, case by case: models of a known promise, and the rule for each outcome."""

import math

import pytest
import torch
from searches import zeros

from torch_zerohess.search.descent.loss_step import after_loss
from torch_zerohess.search.descent.progress import DescentProgress
from torch_zerohess.search.protocol.state import Arrivals, Best
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel

END = torch.tensor([1.0, 2.0, 3.0, 4.0], dtype=torch.float64)
BEST = torch.tensor([5.0, 6.0, 7.0, 8.0], dtype=torch.float64)


def step(*, length=0.6, promised=1.0, rank=4, significance=1.0, **known):
    """A step of the length, from a loss of 10, whose linear model of the rank promises a decrease."""
    s = torch.zeros(rank, dtype=torch.float64)
    s[0] = length * 2.0  # sqrt(n)
    model = LocalModel(
        10.0,
        -promised * s / s.square().sum(),
        torch.zeros(rank, rank, dtype=torch.float64),
        None if rank == 4 else torch.eye(4, dtype=torch.float64)[:, :rank],
        zeros(rank),
        zeros(rank),
        significance,
    )
    settings = {"value": 10.0, "lowest": Best(BEST, 10.0), "model": model, "step": s, "phase": "trial", **known}
    return DescentProgress(best=Best(BEST, 10.0), center=zeros(4), pool=Pool.empty(4), **settings)


@pytest.mark.parametrize(
    ("length", "factor"), [(0.95, 1.2), (0.85, 1.0), (0.45, 1.0), (0.35, 0.75)], ids=["long", "", "", "short"]
)
def test_a_step_that_lowers_the_loss_is_taken(length, factor):
    after = after_loss(step(length=length, sigma=0.5, patience=1), END, 9.0, 0.0)
    assert torch.equal(after.center, END)
    assert (after.value, after.phase, after.patience) == (9.0, "trial", 0)
    assert after.sigma == pytest.approx(0.5 * factor)


def test_sigma_grows_only_where_the_model_was_good():
    """The step achieves 0.6, or 0.4, of what its model promised."""
    assert after_loss(step(length=0.95), END, 9.4, 0.0).sigma == pytest.approx(1.2)
    assert after_loss(step(length=0.95), END, 9.6, 0.0).sigma == 1.0


def test_a_better_sample_is_preferred():
    after = after_loss(step(length=0.95, lowest=Best(BEST, 8.0)), END, 9.0, 0.0)
    assert torch.equal(after.center, BEST)
    assert (after.value, after.sigma) == (8.0, 1.0)


@pytest.mark.parametrize("loss", [10.0, 11.0, math.inf])
@pytest.mark.parametrize(("rounds", "need"), [(0, 1), (1, 2), (2, 4), (5, 4)])
def test_a_step_that_does_not_is_refused(loss, rounds, need):
    """Sigma shrinks, and samples are asked for: more in later rounds, n at most."""
    after = after_loss(step(arrivals=Arrivals(rounds=rounds)), END, loss, 0.0)
    assert torch.equal(after.center, zeros(4))
    assert (after.value, after.sigma, after.phase) == (10.0, 0.75, "sample")
    assert (after.need, after.paired) == (need, need > 1)


@pytest.mark.parametrize(("achieved", "phase"), [(0.75, "sample"), (0.65, "trial")])
def test_a_model_that_promises_well_gets_samples_where_it_knows_nothing(achieved, phase):
    after = after_loss(step(rank=3), END, 10.0 - achieved, 0.0)
    assert after.phase == phase
    if phase == "sample":
        assert (after.need, after.paired) == (1, False)
    assert after_loss(step(rank=4), END, 10.0 - achieved, 0.0).phase == "trial"  # there is nothing unknown


@pytest.mark.parametrize(("decrease", "moves"), [(0.19, False), (0.21, True)])
def test_a_decrease_within_twice_the_noise_does_not_count(decrease, moves):
    after = after_loss(step(), END, 10.0 - decrease, 0.1)
    assert torch.equal(after.center, END if moves else zeros(4))


@pytest.mark.parametrize(
    ("sigma", "patience", "then"),
    [
        (1.0, 0, (1.3, 0)),
        (1.5, 0, (1.6, 0)),  # at most 1.6
        (1.6, 0, (1.6, 1)),
        (1.6, 1, (1.6, 2)),
        (1.6, 2, (1.2, 2)),  # no longer
    ],
)
def test_on_a_plateau_sigma_grows_for_a_while(sigma, patience, then):
    after = after_loss(step(significance=-1.0, sigma=sigma, patience=patience), END, 10.0, 0.0)
    assert (after.sigma, after.patience) == (pytest.approx(then[0]), then[1])
    assert after.phase == "sample"


def test_a_plateau_never_narrows_sigma():
    """Good steps may have widened it beyond what a plateau widens it to."""
    assert after_loss(step(significance=-1.0, sigma=5.0), END, 11.0, 0.0).sigma == 5.0
