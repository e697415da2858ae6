"""ZeroGrads and RELAX on network tasks: that they learn because of their surrogate, and what it sees."""

import math

import pytest
import torch
from small import BUMP, Bump, trained
from torch import nn

from experiments.methods import learned_networks
from experiments.methods.learned_networks import Surrogate
from experiments.problems.network_task import Size
from experiments.problems.tasks import cnn_throw
from experiments.runs.network_trial import NetworkTrial

LEARNING = Bump(Size(16, 1, 2, evaluations=1500, images=256, held_out=32))


def improvement(name, **settings) -> float:
    """Parameter error before over that after the training."""
    _, trial = trained(name, LEARNING, **settings)
    return trial.rows[0].parameter_error / LEARNING.parameter_error(trial.encoder)


@pytest.mark.parametrize("name", ["zerograds", "relax"])
def test_targets_that_are_no_images(name):
    """The places on the floor at which CNN-THROW aims."""
    task = cnn_throw.Throw(Size(16, 1, 1, evaluations=16, images=4, held_out=1), threads=1)
    outcome, trial = trained(name, task)
    assert outcome.evaluations == 16
    assert all(math.isfinite(row.image_error) for row in trial.rows)


def test_zerograds_learns_by_its_fit():
    assert improvement("zerograds") > 10
    assert improvement("zerograds", fits=0) < 2


def test_relax_learns(monkeypatch):
    assert improvement("relax") > 10
    monkeypatch.setattr(learned_networks, "lax", lambda f, h, x, u, sigma: 0.0 * h(x)[:, None] * u)
    assert improvement("relax") == 1.0


def test_the_surrogate_sees_parameters_and_image():
    """In units of the first sigma, relative to the mean prediction; losses over the mean of the first call."""
    trial = NetworkTrial(BUMP, "zerograds", 0)
    surrogate, images = Surrogate(trial, (4,), nn.Tanh), trial.images[:3]
    with torch.no_grad():
        centre = trial.encoder(trial.images).mean(0)
    z = centre + torch.tensor([[0.0], [1.0], [2.0]])
    seen = nn.functional.avg_pool2d(images, 2).flatten(1)  # 16 pixels to 8
    inputs = torch.cat([torch.tensor([[0.0], [1.0], [2.0]]), seen], 1)
    torch.testing.assert_close(surrogate.of(images)(z), surrogate.network(inputs))
    first, mean = surrogate.loss(z, images)
    again, _ = surrogate.loss(z[:1], images[:1])
    truth = BUMP.loss(z, images)
    torch.testing.assert_close(first, truth / truth.mean())
    assert mean == pytest.approx(float(truth.mean()))
    torch.testing.assert_close(again, first[:1])
