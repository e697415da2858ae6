"""Which parameters outputs are found to depend on: the rate of false ones, and that most true ones are found."""

import math

import pytest
import torch

from torch_zerohess.surrogates.sparse_evidence import Evidence, confirmed
from torch_zerohess.surrogates.sparse_fit import SparseSettings, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

N, TOUCHED, K = 100, 60, 32
SETTINGS = SparseSettings(16, robust=False)


def curved(u, generator):
    return u[:, :TOUCHED] + u[:, :TOUCHED].square()


def noisy(u, generator):
    return u[:, :TOUCHED] + torch.randn(len(u), TOUCHED, generator=generator)


def after(black_box, batches, seed):
    generator = torch.Generator().manual_seed(seed)
    evidence, fitted = Evidence.none(N, torch.device("cpu")), None
    for _ in range(batches):
        u = torch.randn(K, N, generator=generator)
        d, before = black_box(u, generator), fitted
        fitted = fit_sparse(u, d, torch.Size([TOUCHED]), SETTINGS, before)
        evidence = evidence.with_batch(fitted, before, u, d)
    return evidence


@pytest.mark.parametrize("black_box", [curved, noisy])
def test_few_others_are_found_and_most_of_those_with_an_effect(black_box):
    """In six batches at a rate of 0.5 % there are at most 3 % false ones, by expectation: 36 of 1200 in 20 searches."""
    found = torch.stack([after(black_box, 6, seed).found for seed in range(20)])
    assert int(found[:, TOUCHED:].sum()) <= 36
    assert float(found[:, :TOUCHED].double().mean()) > 0.9


def test_new_samples_are_standard_normal_where_nothing_depends_on_a_parameter():
    """Whatever the slopes are. The mean of 4000 squares is within five standard errors of 1, sqrt(2 / 4000)."""
    generator, every = torch.Generator().manual_seed(0), []
    index = torch.arange(N)[:, None].expand(N, 1)
    slopes = SparseJacobian(index, torch.ones(N, 1), torch.zeros(N, 1), N, torch.Size([N]))
    for _ in range(100):
        u = torch.randn(K, N, generator=generator)
        d = torch.cat([curved(u, generator), torch.randn(K, N - TOUCHED, generator=generator)], 1)
        every.append(confirmed(slopes, u, d))
    z = torch.stack(every)
    assert float(z[:, :TOUCHED].mean()) > 3.0
    assert float(z[:, TOUCHED:].square().mean()) == pytest.approx(1.0, abs=5 * math.sqrt(2 / 4000))
    assert float(z[:, TOUCHED:].mean()) == pytest.approx(0.0, abs=5 / math.sqrt(4000))


def test_rounding_is_no_evidence():
    """What outputs change by is far below the slopes that were fitted before."""
    u = torch.randn(K, N, generator=torch.Generator().manual_seed(0))
    index = torch.arange(N)[:, None]
    slopes = SparseJacobian(index, torch.rand(N, 1), torch.zeros(N, 1), N, torch.Size([N]))
    assert bool((confirmed(slopes, u, torch.zeros(K, N)).abs() < 1e-6).all())
