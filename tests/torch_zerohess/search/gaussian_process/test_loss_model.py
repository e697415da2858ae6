"""The optimistic loss of predicted outputs against its formula for a mean square."""

import pytest
import torch
from searches import waves

from torch_zerohess.search.gaussian_process.loss_model import LossModel
from torch_zerohess.surrogates.gaussian_process import GaussianProcess
from truths import normal, vector


@pytest.mark.parametrize("optimism", [0.0, 0.3, 2.0])
def test_the_optimistic_loss_of_a_mean_square_is_that_of_the_nearest_output(optimism):
    points, x = 2 * normal(8, 2), 2 * normal(50, 2, seed=3)
    target = waves(vector(0.5, -0.2)[None])[0]
    process = GaussianProcess.fit(points, waves(points))
    model = LossModel(process, waves(points[:1])[0], lambda y: (y - target).square().mean(), torch.Size([5]), optimism)
    c = process.covariance(x)
    away = (process.mean + c @ process.weights - target).square().mean(1).sqrt()
    nearest = (away - optimism * process.uncertainty(c).sqrt()).clamp_min(0.0)
    assert torch.allclose(model(x), nearest.square(), atol=1e-9)


def test_an_expansion_knows_whether_it_holds():
    points = 2 * normal(8, 2)
    process = GaussianProcess.fit(points, waves(points))
    x = points[3]
    output = process.mean + (process.covariance(x[None]) @ process.weights)[0]
    quadratic = lambda y: (y - 1.0).square().mean()  # noqa: E731
    quartic = lambda y: (y - 1.0).pow(4).mean()  # noqa: E731
    for loss, holds in ((quadratic, True), (quartic, False)):
        model = LossModel(process, waves(points[:1])[0], loss, torch.Size([5]), 0.0)
        assert model.is_true(x, float(loss(output))) is holds
