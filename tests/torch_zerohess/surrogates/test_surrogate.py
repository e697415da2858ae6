"""What all surrogates have in common."""

import pytest
import torch

from torch_zerohess import surrogates


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
