"""A dense Jacobian that samples determine is exact where outputs are linear, and stays out where a sparse one is."""

from dataclasses import replace

import torch

from torch_zerohess.surrogates.determined_jacobian import better_determined
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

N, M = 6, 9
GENERATOR = torch.Generator().manual_seed(0)
TRUE = torch.randn(M, N, generator=GENERATOR)
U = torch.randn(12, N, generator=GENERATOR)
NOISE = torch.randn(12, M, generator=GENERATOR)
EMPTY = SparseJacobian.empty(N, (M,), 2, U)


def test_linear_outputs_have_an_exact_jacobian():
    found = better_determined(EMPTY, U, U @ TRUE.mT + 3.0)
    torch.testing.assert_close(found.dense(), TRUE, rtol=0.0, atol=1e-5)
    assert found.explained > 1 - 1e-9


def test_fewer_samples_than_parameters_determine_nothing():
    assert better_determined(EMPTY, U[: N + 1], (U @ TRUE.mT)[: N + 1]) is EMPTY


def test_samples_that_are_left_out_tell_that_it_does_not_predict():
    assert better_determined(EMPTY, U, NOISE) is EMPTY


def test_a_sparse_jacobian_that_predicts_better_stays():
    sparse = replace(EMPTY, explained=0.9999)
    assert better_determined(sparse, U, U @ TRUE.mT + 0.1 * NOISE) is sparse
