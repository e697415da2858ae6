"""Slopes on a known support, and their standard errors against fits without one sample at a time.

All of it by the C++ extension and by torch.
"""

import pytest
import torch

from torch_zerohess.sampling import extension
from torch_zerohess.surrogates.sparse_fit import SparseSettings, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.surrogates.sparse_regression import predicted, slopes, slopes_by_ridges
from truths import normal

K, M, N = 30, 5, 3
needs_extension = pytest.mark.skipif(not extension.available, reason="the operators are those of the extension")


@pytest.fixture(autouse=True, params=[pytest.param(True, marks=needs_extension, id="extension"), "torch"])
def backend(request, monkeypatch):
    """By the extension, or by torch alone."""
    monkeypatch.setattr(extension, "available", request.param is True)


def fitted(u, d, weights, penalty, prior):
    """Slopes [M, N] by weighted least squares with a constant, and a penalty [N] on what differs from the prior."""
    design = torch.cat([u, torch.ones(len(u), 1).double()], 1)
    gram = design.mT @ (weights[:, None] * design) + torch.diag(torch.cat([penalty, torch.zeros(1).double()]))
    right = design.mT @ (weights[:, None] * d)
    right[:N] += penalty[:, None] * prior.mT
    return torch.linalg.solve(gram, right)[:N].mT


@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("old", [False, True])
def test_variances_are_those_of_fits_without_one_sample(weighted, old):
    """The sum of the squared changes of a slope when one sample is left out, and the error of the prior."""
    u, d = normal(K, N), normal(K, M, seed=1) * (1 + normal(K, 1, seed=2).square())
    weights = normal(K, seed=3).square() + 0.1 if weighted else torch.ones(K).double()
    weights *= K / weights.sum()
    prior = normal(M, N, seed=4) if old else torch.zeros(M, N).double()
    root, index = weights.sqrt()[:, None], torch.arange(N).expand(M, N)
    before = SparseJacobian(index, prior, torch.zeros(M, N), N, torch.Size([M]))
    v, e = (root * (one - weights @ one / K) for one in (u, d))
    ridge = 0.3 if old else 0.1
    values, errors = slopes(v, e, index, torch.ones(M, N).bool(), before, (0.3, 0.1), weights / K)
    penalty = ridge * v.square().sum(0)
    whole = fitted(u, d, weights, penalty, prior)
    torch.testing.assert_close(values, whole)
    expected = torch.zeros(M, N).double()
    for k in range(K):
        some = torch.arange(K) != k
        expected += (fitted(u[some], d[some], weights[some], penalty, prior) - whole).square()
    gram = v.mT @ v
    inverse = torch.linalg.inv(gram + torch.diag(penalty))
    left, spent = (e - v @ whole.mT).square().sum(0), (inverse @ gram).trace()
    expected += (left / (K - 1 - spent))[:, None] * (inverse @ torch.diag(penalty) @ inverse).diagonal()
    expected += ((whole - prior) @ torch.diag(penalty) @ inverse).square()
    torch.testing.assert_close(errors.square(), expected)


def test_slopes_by_several_ridges_are_those_of_weighted_least_squares():
    """Some entries are old, some new, and some are not used."""
    u, d, some = normal(K, N), normal(K, M, seed=1), torch.arange(M * N).view(M, N) % 4
    index, used = torch.arange(N).expand(M, N), some != 3
    prior = torch.where(used & (some == 0), normal(M, N, seed=4), 0.0)
    before = SparseJacobian(index, prior, torch.zeros(M, N), N, torch.Size([M]))
    choices = [(1e-4, 1e-4), (0.3, 0.1)]
    for ridges, values in zip(choices, slopes_by_ridges(u, d, index, used, before, choices), strict=True):
        expected = torch.zeros(M, N).double()
        for row in range(M):
            A, old = u[:, used[row]], prior[row, used[row]]
            penalty = torch.where(old != 0, *torch.tensor(ridges).double()) * A.square().sum(0)
            expected[row, used[row]] = torch.linalg.solve(
                A.mT @ A + torch.diag(penalty), A.mT @ d[:, row] + penalty * old
            )
        torch.testing.assert_close(values, expected)


def test_a_fit_with_as_many_samples_as_it_takes_has_finite_errors():
    """10 samples, 8 entries and a constant: a fit without one sample is of more unknowns than samples."""
    u = normal(10, 8)
    J = fit_sparse(u.float(), (u @ normal(8, 40, seed=1)).float(), torch.Size([40]), SparseSettings(8, rate=0.9))
    assert bool(torch.isfinite(J.standard_error).all())


def test_a_search_may_do_without_robust_errors():
    """Slopes are the same; errors are those of samples of equal variance."""
    u = normal(200, 20)
    d = u * (1 + u.square())  # the variance of the residual grows with the perturbation
    found = [fit_sparse(u, d, torch.Size([20]), SparseSettings(1, robust=robust)) for robust in (True, False)]
    assert torch.equal(found[0].dense(), found[1].dense())
    assert bool((found[0].standard_error > 1.5 * found[1].standard_error).all())


def random_case(samples, dtype):
    """Directions, changes, supports with holes, and previous slopes of which some are on the supports."""
    m, n, keep = 60, 40, 12
    u, d = normal(samples, n).to(dtype), normal(samples, m, seed=1).to(dtype)
    index = normal(m, n, seed=2).argsort(1)[:, :keep]
    used = normal(m, keep, seed=3) < 1.0
    used[:, 3] = False
    values = torch.where(normal(m, 8, seed=4) > 0.0, normal(m, 8, seed=5), 0.0).to(dtype)
    known = normal(m, n, seed=6).argsort(1)[:, :8]
    return u, d, index, used, SparseJacobian(known, values, torch.zeros_like(values), n, torch.Size([m]))


@needs_extension
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("samples", [15, 32, 100])
def test_extension_and_torch_agree(samples, dtype, monkeypatch):
    case, bound = random_case(samples, dtype), 300 * torch.finfo(dtype).eps
    constant, choices = torch.full((samples,), 1 / samples, dtype=dtype), [(0.03, 0.03), (0.3, 0.1)]
    results = []
    for available in (True, False):
        monkeypatch.setattr(extension, "available", available)
        made = slopes_by_ridges(*case, choices)
        for shortened in (True, False):
            for one in (None, constant):
                made += slopes(*case, choices[1], one, shortened=shortened)
        results.append(made)
    for got, expected in zip(*results, strict=True):
        assert got.dtype == dtype
        torch.testing.assert_close(got, expected, rtol=bound, atol=bound * float(expected.abs().max()))


def test_directions_without_a_solution_are_an_error():
    u, d, *rest = random_case(20, torch.float64)
    u[0, 0] = torch.inf
    with pytest.raises(torch.linalg.LinAlgError, match="positive"):
        slopes(u, d, *rest, (0.3, 0.1))


@needs_extension
def test_indices_beyond_the_parameters_are_refused():
    u, d, index, *rest = random_case(20, torch.float64)
    extension.available = True
    for wrong in (-1, 40):
        with pytest.raises(RuntimeError, match="index has numbers beyond the parameters"):
            slopes(u, d, index.clone().fill_(wrong), *rest, (0.3, 0.1))


def test_predicted_changes_are_products_with_the_rows():
    u, _, index, _, _ = random_case(20, torch.float64)
    values = torch.where(normal(60, 12, seed=7) > 0.0, normal(60, 12, seed=8), 0.0)
    J = torch.zeros(60, 40).double().scatter_(1, index, values)
    torch.testing.assert_close(predicted(index, values, u), u @ J.mT)
    assert bool((predicted(index, 0.0 * values, u) == 0.0).all())
