"""What all surrogates have in common."""

import functools

import pytest
import torch

from torch_zerohess import surrogates
from torch_zerohess.surrogates.surrogate import scaled


@pytest.mark.parametrize(
    "surrogate",
    [
        surrogates.AutomaticSurrogate(),
        surrogates.LinearSurrogate(),
        surrogates.LowRankSurrogate(surrogates.LinearSurrogate()),
        surrogates.ProcessSurrogate(),
        surrogates.SparseSurrogate(),
    ],
    ids=lambda one: type(one).__name__,
)
def test_a_surrogate_that_was_not_fitted_says_so(surrogate):
    with pytest.raises(RuntimeError, match="fit the surrogate to evaluations before it is used"):
        surrogate(torch.zeros(1, 3))
    if hasattr(surrogate, "variance"):
        with pytest.raises(RuntimeError, match="fit the surrogate to evaluations before it is used"):
            surrogate.variance(torch.ones(3))


@pytest.mark.parametrize(
    "make",
    [
        surrogates.AutomaticSurrogate,
        surrogates.LinearSurrogate,
        functools.partial(surrogates.LowRankSurrogate, surrogates.LinearSurrogate()),
        surrogates.ProcessSurrogate,
        surrogates.SparseSurrogate,
    ],
)
def test_a_capacity_is_at_least_two(make):
    """With a capacity of 0, `points[-0:]` would be all of them."""
    for capacity in (1, 0, -5):
        with pytest.raises(ValueError, match=f"capacity must be at least 2, got {capacity}"):
            make(capacity=capacity)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_numbers_are_scaled_in_a_copy(dtype):
    numbers = torch.tensor([1e25, -3e24], dtype=dtype)
    before = numbers.clone()
    found, size = scaled(numbers)
    assert torch.equal(numbers, before)
    assert torch.equal(found * size, before)
    assert float(found.abs().max()) <= 1.0
