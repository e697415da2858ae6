"""Networks fitted to renders of known parameters."""

from dataclasses import replace

import pytest
import torch
from small import SIZE, Bump, trained

from experiments.methods.rendered_pairs import output_metric


@pytest.mark.parametrize(("method", "left"), [("memory_pairs", 0.1), ("random_pairs", 0.1), ("prior_pairs", 0.02)])
def test_uses_its_evaluations_and_reduces_the_error(method, left):
    outcome, trial = trained(method, Bump(replace(SIZE, evaluations=60)), fits=300)
    assert outcome.evaluations == 60
    assert trial.rows[-1].parameter_error < left * trial.rows[0].parameter_error


def test_the_pairs_come_after_newton():
    _, newton = trained("memory_newton", Bump(replace(SIZE, evaluations=60)))
    _, pairs = trained("memory_pairs", Bump(replace(SIZE, evaluations=60)), fits=300)
    count = len(newton.rows)
    assert [row.parameter_error for row in pairs.rows[:count]] == [row.parameter_error for row in newton.rows]
    assert pairs.rows[-1].parameter_error < 0.2 * newton.rows[-1].parameter_error


def test_metric_of_a_surrogate_is_its_gauss_newton_matrix():
    def surrogate(z):
        return torch.stack([z[:, 0] * z[:, 1], z[:, 1].square()], 1)[:, :, None]

    points = torch.rand(70, 2, dtype=torch.float64)
    x, y = points.T
    truth = torch.stack([torch.stack([y * y, x * y], 1), torch.stack([x * y, x * x + 4 * y * y], 1)], 1)
    expected = truth / (x * x + 5 * y * y).mean() * 2
    torch.testing.assert_close(output_metric(surrogate, points), expected)
