"""Which quadratic is that at the end of a search, and whether it is flat along some direction: by hand."""

import math
from types import SimpleNamespace

import pytest
import torch

from torch_zerohess.minimization.derivatives import Derivatives, is_flat, quadratic_at
from torch_zerohess.surrogates.quadratic import LocalModel
from truths import vector


def found(hessian, gradient=(0.0, 0.0), error=0.0):
    hessian = torch.tensor(hessian).double()
    errors = {"gradient": vector(error, error), "hessian_diagonal": vector(error, error)}
    return Derivatives(torch.tensor(gradient).double(), hessian, errors, vector(1.0, 1.0))


@pytest.mark.parametrize(
    ("hessian", "expected"),
    [
        ([[1.0, 1.0], [1.0, 1.0]], True),
        ([[1.0, 1.0], [1.0, 1.0 + 1e-5]], False),
        ([[1.0, 0.0], [0.0, -1e-5]], False),  # an error of the fit
        ([[1.0, 0.0], [0.0, 1e-7]], True),
        ([[0.0, 0.0], [0.0, 0.0]], False),  # a kink
        ([[math.nan, 0.0], [0.0, 0.0]], False),
    ],
)
def test_a_quadratic_is_flat_along_an_eigenvector(hessian, expected):
    assert is_flat(found(hessian), vector(1.0, 1.0)) is expected


def test_curvatures_are_in_units_of_sigma():
    assert not is_flat(found([[1.0, 0.0], [0.0, 1e-12]]), vector(1.0, 1e6))
    assert is_flat(found([[1.0, 0.0], [0.0, 1.0]]), vector(1.0, 1e-6))


def test_a_slope_as_at_a_bound_is_not_flat():
    bent = [[1.0, 0.0], [0.0, 0.0]]
    assert is_flat(found(bent, gradient=(1.0, 1e-4)), vector(1.0, 1.0))
    assert not is_flat(found(bent, gradient=(0.0, 0.1)), vector(1.0, 1.0))


def test_nothing_is_flat_that_the_evaluations_do_not_determine():
    flat = found([[1.0, 1.0], [1.0, 1.0]], error=math.inf)
    assert not is_flat(flat, vector(1.0, 1.0))
    assert not is_flat(Derivatives(None, None, None, vector(1.0, 1.0)), vector(1.0, 1.0))


@pytest.mark.parametrize("loss", [None, torch.sum])
def test_a_model_that_evaluations_do_not_determine_gives_way_to_all_of_them(loss):
    """A model of outputs does not know its errors. One of the loss alone with infinite errors is not determined."""
    points = torch.randn(12, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    losses = points.square().sum(1) + 0.5 * (7 * points[:, 0]).sin()
    unknown = vector(math.inf, math.inf)
    own = LocalModel(0.0, vector(0.0, 0.0), 8.0 * torch.eye(2).double(), None, unknown, unknown)
    search = SimpleNamespace(unit=vector(1.0, 1.0), loss=loss, model_at_best=lambda x: (own, 1.0))
    hessian = quadratic_at(vector(0.0, 0.0), search, points, losses, 0.0).hessian
    assert torch.equal(hessian, own.hessian) == (loss is not None)
