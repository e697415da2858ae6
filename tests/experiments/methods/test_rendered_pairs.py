"""Networks fitted to renders of known parameters."""

from dataclasses import replace

import pytest
import torch
from small import SIZE, Bump, bump, trained

from experiments.methods import METHODS
from experiments.methods.rendered_pairs import _in_prior, _in_range, output_metric
from experiments.problems import catalogue
from experiments.problems.network_task import Encoder
from experiments.runs.network_trial import NetworkTrial

FEW = {"least_steps": 0}


@pytest.mark.parametrize(
    ("method", "left", "settings"),
    [("memory_pairs", 0.1, {"newton": FEW}), ("random_pairs", 0.1, {}), ("prior_pairs", 0.02, {})],
)
def test_uses_its_evaluations_and_reduces_the_error(method, left, settings):
    outcome, trial = trained(method, Bump(replace(SIZE, evaluations=60)), fits=300, **settings)
    assert outcome.evaluations == 60
    assert trial.rows[-1].parameter_error < left * trial.rows[0].parameter_error


def test_the_pairs_come_after_newton():
    _, newton = trained("memory_newton", Bump(replace(SIZE, evaluations=60)), **FEW)
    _, pairs = trained("memory_pairs", Bump(replace(SIZE, evaluations=60)), newton=FEW, fits=300)
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


def test_where_the_pairs_of_the_rivals_lie():
    trial = NetworkTrial(Bump(replace(SIZE, evaluations=200)), "random_pairs", 0)
    everywhere, known = _in_range(trial), _in_prior(trial)
    assert everywhere.shape == known.shape == (200, 1)
    assert 4.5 <= float(everywhere.min()) < 6.0 < 21.0 < float(everywhere.max()) <= 22.5  # of the network's outputs
    assert 11.5 <= float(known.min()) < float(known.max()) <= 15.5  # of the training images


def test_a_prior_that_takes_simulations_to_draw_from_is_refused():
    reason = METHODS["prior_pairs"].unusable(catalogue.load("cnn_throw"))
    assert reason == "the distribution of the training targets is known through simulations alone"
    assert METHODS["random_pairs"].unusable(catalogue.load("cnn_throw")) is None


class Dim(Bump):
    """A column of light and a row of light, which is a hundred times dimmer."""

    name = "dim"
    n = 2

    def encoder(self):
        return Encoder(self.size, (4.5, 4.5), (22.5, 22.5))

    def load(self):
        return lambda x: bump(x[:, :1]) + 0.01 * bump(x[:, 1:]).transpose(1, 2)

    def parameters(self, count, generator, *, held_out):
        return 11.5 + 4 * torch.rand(count, 2, generator=generator)


def test_a_parameter_that_changes_the_render_more_counts_more(monkeypatch):
    def errors():
        _, trial = trained("prior_pairs", Dim(replace(SIZE, evaluations=60)), fits=60)
        images, x = trial.task.held_out
        with torch.no_grad():
            return (trial.encoder(images) - x).square().mean(0)

    weighted = errors()
    monkeypatch.setattr(
        "experiments.methods.rendered_pairs.output_metric", lambda _, points: torch.eye(2).expand(60, 2, 2)
    )
    assert weighted[0] < errors()[0]
