"""Covariances of fitted parameters: against least squares in closed form, and against derivatives by torch."""

import functools
from dataclasses import replace

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.minimization.covariance import covariance
from truths import normal

TIMES, SPREAD = torch.linspace(0, 3, 30).double(), 0.05


def line(x):
    """[K, 2] -> [K, 30]."""
    return x[:, :1] + x[:, 1:] * TIMES


def decay(x):
    """[K, 2] -> [K, 30]."""
    return x[:, :1] * torch.exp(-x[:, 1:] * TIMES)


def likelihood(model):
    """Minus its logarithm, but for a constant, of data with independent Gaussian errors around (2, 1)."""
    data = model(torch.tensor([[2.0, 1.0]]).double())[0] + SPREAD * normal(30)
    return lambda y: 0.5 * ((y - data) / SPREAD).square().sum()


@functools.cache
def fitted(model, *, outputs, bounds=None, **settings):
    loss = likelihood(model)
    if outputs:
        return zh.minimize(model, [1.5, 0.7], sigma=0.3, loss=loss, bounds=bounds, seed=0, **settings)
    fn = torch.func.vmap(lambda x: loss(model(x[None])[0]))
    return zh.minimize(fn, [1.5, 0.7], sigma=0.3, bounds=bounds, seed=0, **settings)


@pytest.mark.parametrize("bounds", [None, (0, 5)], ids=["descent", "gaussian_process"])
@pytest.mark.parametrize("outputs", [True, False], ids=["image", "loss"])
def test_of_a_line_it_is_the_covariance_of_least_squares(outputs, bounds) -> None:
    A = torch.stack([torch.ones(30).double(), TIMES], 1)
    truth = SPREAD**2 * torch.linalg.inv(A.mT @ A)
    torch.testing.assert_close(fitted(line, outputs=outputs, bounds=bounds).covariance(), truth, rtol=1e-3, atol=0)


@pytest.mark.parametrize("bounds", [None, (0, 5)], ids=["descent", "gaussian_process"])
@pytest.mark.parametrize("outputs", [True, False], ids=["image", "loss"])
def test_of_a_decay_it_is_the_inverse_of_the_hessian(outputs, bounds) -> None:
    fit, loss = fitted(decay, outputs=outputs, bounds=bounds), likelihood(decay)
    truth = torch.linalg.inv(torch.func.hessian(lambda x: loss(decay(x[None])[0]))(fit.x))
    found = fit.covariance()
    torch.testing.assert_close(found, truth, rtol=0.06, atol=0)
    if fit.engine == "gaussian_process" and outputs:  # second derivatives of the output are left out
        J = torch.func.jacrev(lambda x: decay(x[None])[0])(fit.x) / SPREAD
        truth = torch.linalg.inv(J.mT @ J)
    share = fit.standard_errors["hessian_diagonal"] * found.diagonal()
    error = (found - truth).diagonal().abs() / truth.diagonal()
    assert bool((error < 3 * share + 5e-3).all())


def test_parameters_in_very_different_units() -> None:
    H = torch.tensor([[1.0, 0.5e-10], [0.5e-10, 1e-20]]).double()
    truth = torch.tensor([[4 / 3, -2e10 / 3], [-2e10 / 3, 4e20 / 3]]).double()
    torch.testing.assert_close(covariance(H, torch.zeros(2)), truth)


@pytest.mark.parametrize(
    ("hessian", "errors", "message"),
    [
        ([[1.0, 0.0], [0.0, -0.1]], [0.0, 0.0], "eigenvalue -1, mostly along parameter 1"),
        ([[0.0, 0.0], [0.0, 1.0]], [0.0, 0.0], "eigenvalue 0, mostly along parameter 0"),
        ([[1.0, 0.0], [0.0, 4.0]], [0.5, 4.0], r"within its errors .* parameter 1, 0\.25, may be wrong by 1 of itself"),
        (
            [[1.0, 0.0], [0.0, 4.0]],
            [float("inf"), 0.0],
            r"too few evaluations near x vary parameter 0: search again .* fixed=\[0\]",
        ),
        ([[1.0, float("nan")], [0.0, 4.0]], [0.0, 0.0], "must be finite"),
    ],
)
def test_where_it_is_not_known(hessian, errors, message) -> None:
    with pytest.raises(ValueError, match=message):
        covariance(torch.tensor(hessian).double(), torch.tensor(errors).double())


def test_a_parameter_that_the_data_do_not_determine_beside_another() -> None:
    """The data depend on the sum of the parameters, and a millionth as much on their difference."""
    fit = fitted(lambda x: line(x) + line(x.flip(1)) + 1e-6 * (x[:, :1] - x[:, 1:]), outputs=False, restarts=0)
    with pytest.raises(ValueError, match="the data do not determine this parameter beside the others"):
        fit.covariance()


def test_fixed_parameters_are_held_at_their_values() -> None:
    """The covariance given the fixed ones is smaller than that of the whole by the part that they explain."""
    root = torch.tensor([[2.0, 0.3, -0.5], [0.1, 1.0, 0.4], [0.2, -0.6, 1.5]]).double()
    H = root @ root.mT
    whole, free = torch.linalg.inv(H), torch.tensor([0, 2])
    explained = whole[:, 1:2] @ whole[1:2] / whole[1, 1]  # Schur complement of the fixed one
    for fixed in ([1], [-2], (1, 1), torch.tensor([1])):
        found = covariance(H, torch.zeros(3), fixed)
        torch.testing.assert_close(found[free[:, None], free], (whole - explained)[free[:, None], free])
        assert not found[1].any()
        assert not found[:, 1].any()


def test_a_parameter_that_is_not_determined_may_be_fixed() -> None:
    H = torch.tensor([[4.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, -1.0]]).double()
    with pytest.raises(ValueError, match=r"along parameter 2: .* by fixed=\[2\]"):
        covariance(H, torch.zeros(3))
    with pytest.raises(ValueError, match=r"along parameter ([01]): .* by fixed=\[\1\]"):
        covariance(H, torch.zeros(3), [2])
    assert torch.equal(covariance(H, torch.zeros(3), [1, 2]), torch.diag(torch.tensor([0.25, 0.0, 0.0]).double()))
    errors = torch.tensor([0.5, 0.0, float("nan")])  # of a fixed parameter it does not matter
    assert float(covariance(H, errors, [1, 2])[0, 0]) == 0.25
    with pytest.raises(ValueError, match=r"variance of parameter 2, 1, may be wrong by 2 .* by fixed=\[2\]"):
        covariance(torch.eye(3).double(), torch.tensor([0.0, 9.0, 2.0]), [1])


@pytest.mark.parametrize(
    ("fixed", "error", "message"),
    [
        ([2], ValueError, "fixed must be numbers of the 2 parameters, from -2 to 1, got 2"),
        ([0, 1], ValueError, "fixed must leave a parameter whose covariance is sought, got all 2"),
        (0, TypeError, r"fixed must be a list of numbers of parameters, as \[0\], got 0"),
        ("0", TypeError, "fixed must be a list of numbers of parameters"),
        ([0.0], TypeError, r"fixed must be an integer, got 0\.0"),
        ([True, False], TypeError, "fixed must be an integer, got True"),
    ],
)
def test_what_cannot_be_fixed(fixed, error, message) -> None:
    fit = fitted(decay, outputs=False)
    with pytest.raises(error, match=message):
        fit.covariance(fixed)


def test_the_covariance_of_a_fit_with_a_fixed_parameter() -> None:
    fit = fitted(decay, outputs=False)
    H = fit.hessian.double()
    assert float(fit.covariance(fixed=[1])[0, 0]) == pytest.approx(1.0 / float(H[0, 0]), rel=1e-12)
    assert float(fit.covariance()[0, 0]) > float(fit.covariance(fixed=[1])[0, 0])


def test_a_hessian_that_is_not_known() -> None:
    fit = replace(fitted(decay, outputs=False), hessian=None)
    with pytest.raises(ValueError, match="not known, too few evaluations"):
        fit.covariance()


def two_decays(x):
    """[K, 4] -> [K, 30]."""
    return decay(x[:, :2]) + decay(x[:, 2:])


def test_a_search_from_x_with_a_small_sigma_knows_a_nearly_singular_hessian() -> None:
    """The first search has an error of the Hessian that hides its smallest eigenvalue: its condition is 2e8."""
    start = torch.tensor([1.0, 1.0, 1.0, 1.2]).double()
    data = two_decays(start[None])[0] + 1e-5 * normal(30)
    settings = {"loss": lambda y: 0.5 * ((y - data) / 1e-5).square().sum(), "bounds": (0, 5), "restarts": 0, "seed": 0}
    fit = zh.minimize(two_decays, start + 0.05, sigma=0.1, **settings)
    with pytest.raises(ValueError, match="search again from x with loss=, bounds, restarts=0 and a smaller sigma"):
        fit.covariance()
    again = zh.minimize(two_decays, fit.x, sigma=1e-2, **settings)
    J = torch.func.jacrev(lambda x: two_decays(x[None])[0])(again.x) / 1e-5
    torch.testing.assert_close(again.covariance(), torch.linalg.inv(J.mT @ J), rtol=1e-4, atol=0)
