"""Which derivatives evaluations determine, on points whose span is known."""

import pytest
import torch

from torch_zerohess.surrogates.determined import with_true_errors
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
