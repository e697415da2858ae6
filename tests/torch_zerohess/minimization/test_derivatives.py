"""Whether a quadratic is flat along some direction: by hand."""

import math

import pytest
import torch

from torch_zerohess.minimization.derivatives import Derivatives, is_flat
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
