"""Which derivatives evaluations determine, on points whose span is known."""

import pytest
import torch

from torch_zerohess.surrogates.determined import nearest_told, with_true_errors
from torch_zerohess.surrogates.quadratic import fit_outputs, fit_values
from truths import normal


def fitted(u, kind):
    """Return a model of a function without curvature whose errors are infinite where u does not determine it."""
    weights = torch.ones(len(u), dtype=u.dtype)
    noisy = u.sum(1, keepdim=True) + 0.1 * normal(len(u), 1, seed=5)
    if kind == "values":
        return with_true_errors(fit_values(u, noisy[:, 0], weights), u, weights)
    model = fit_outputs(u, noisy, weights, lambda output: output.square().sum(), noisy.shape[1:])
    return with_true_errors(model, u, weights)


@pytest.mark.parametrize("kind", ["values", "outputs"])
@pytest.mark.parametrize("extent", [0.0, 1e-7])
@pytest.mark.parametrize(
    ("across", "unknown"),
    [([1.0, 0.0, 0.0], [True, False, False]), ([1.0, -1.0, 0.0], [True, True, False])],
)
def test_a_derivative_across_the_plane_of_the_evaluations_is_not_known(kind, extent, across, unknown):
    u = normal(20, 3)
    normal_vector = torch.nn.functional.normalize(torch.tensor(across, dtype=torch.float64), dim=0)
    u = u - (1.0 - extent) * (u @ normal_vector)[:, None] * normal_vector
    model = fitted(u, kind)
    assert model.gradient_error.isinf().tolist() == unknown
    assert model.curvature_error.isinf().tolist() == unknown


@pytest.mark.parametrize("kind", ["values", "outputs"])
def test_two_places_along_a_parameter_tell_a_slope_of_outputs_alone(kind):
    """A quadratic of the values takes three."""
    u = normal(20, 2)
    u[:, 0] = (u[:, 0] > 0).double()
    unknown = [kind == "values", False]
    model = fitted(u, kind)
    assert model.gradient_error.isinf().tolist() == unknown
    assert model.curvature_error.isinf().tolist() == unknown


def test_a_neighbourhood_is_widened_until_it_tells_all_slopes():
    near, far = 1e-3 * normal(10, 2), torch.tensor([[0.5, 0.0], [0.4, 0.1]], dtype=torch.float64)
    near[:, 0] = 0.0

    def found(points, patience=10.0):
        x = torch.zeros(2, dtype=torch.float64)
        return nearest_told(
            points, x, 1e-3, 2, lambda sigma: torch.exp(-0.5 * (points / sigma).square().sum(1)), patience
        )

    narrow, wide = found(near), found(torch.cat([near, far]))
    assert narrow.sigma == 1e-3  # none tells them: the first
    assert 0.05 < wide.sigma < 0.5
    assert wide.near[-1]
    torch.testing.assert_close(wide.u * wide.sigma, torch.cat([near, far])[wide.near])
    assert found(far, patience=2e-3) is None
