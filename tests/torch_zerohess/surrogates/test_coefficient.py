"""The regression of a control variate against its definition, and what counts in it."""

import pytest
import torch

from torch_zerohess.surrogates.coefficient import Coefficient
from truths import normal


def test_the_coefficient_follows_the_surrogate() -> None:
    known, truth = Coefficient(), normal(1, 2000)
    assert known.value == 0.0
    known.observe(truth, truth + 0.01 * normal(1, 2000, seed=1))
    assert known.value == pytest.approx(1.0, abs=0.01)
    unrelated = Coefficient()
    unrelated.observe(truth, normal(1, 2000, seed=2))
    assert unrelated.value < 0.1
    opposite = Coefficient()
    opposite.observe(truth, -truth)
    assert opposite.value == 0.0


def test_the_coefficient_is_the_smallest_over_values_and_derivatives() -> None:
    known, truth = Coefficient(), normal(1, 2000)
    slope, bend = normal(1, 500, seed=1), normal(1, 500, seed=2)
    known.observe(truth, truth, [(slope, slope, 0.0), (0.25 * bend, bend, 0.0)])
    assert known.value == pytest.approx(0.25)
    known.observe(truth, truth, [(slope, slope, 0.0), (-bend, bend, 0.0)])
    assert known.value < 0.25


def test_values_that_were_left_out_do_not_count() -> None:
    known, truth = Coefficient(), normal(1, 2000) + 5.0
    kept = torch.rand(1, 2000, generator=torch.Generator().manual_seed(1)) < 0.5
    known.observe(torch.where(kept, truth, 0.0), truth, kept=kept)
    assert known.value == pytest.approx(1.0)


def test_older_calls_count_less() -> None:
    """The regression of 1, then of 1/4, with the weights 0.9 and 1, over the sums of squares 2 and 17/16."""
    known, truth = Coefficient(), normal(1, 2000)
    known.observe(truth, truth)
    known.observe(0.25 * truth, truth)
    assert known.value == pytest.approx((0.9 / 2 + 0.25 * 16 / 17) / (0.9 / 2 + 16 / 17))


def test_one_call_with_large_values_does_not_decide() -> None:
    """The surrogate is right in twenty calls and opposite in one, whose values are a thousand times as large."""
    known, truth = Coefficient(), normal(1, 2000)
    for _ in range(20):
        known.observe(truth, truth, [(truth, truth, 0.0)])
    known.observe(1000.0 * truth, -1000.0 * truth, [(1e6 * truth, -1e6 * truth, 0.0)])
    assert known.value > 0.7


def test_negligible_contributions_do_not_count() -> None:
    known, truth = Coefficient(), normal(1, 2000)
    noise = 1e-6 * normal(1, 500)
    known.observe(truth, truth, [(noise, -noise, 1e-11)])
    assert known.value == pytest.approx(1.0)
    known.observe(truth, truth, [(noise, -noise, 1e-13)])
    assert known.value == 0.0
