"""`torch.vmap` over the operators that are linear in vectors."""

import pytest
import torch

from torch_zerohess.autograd import linear_map
from torch_zerohess.sampling import kernels, proposals
from torch_zerohess.sampling.kernels import Redrawn

V, B, S, M, N = 3, 2, 5, 4, 6
"""Mapped elements, batch, samples, vectors, parameters."""


def _samples(redrawn: bool, count: int) -> tuple[list[torch.Tensor], list[int | None]]:
    """Return samples, or what they are drawn from, of `count` elements, and the mapped dimensions."""
    sigma = torch.rand(N, dtype=torch.float64) + 0.5
    x = torch.randn(B, count, N, dtype=torch.float64)
    drawn = [kernels.sample(7 + k, S, x[:, k], sigma, True, proposals.GAUSSIAN, False, True) for k in range(count)]
    mapped = 1 if count > 1 else None
    rows, u = (torch.stack([one[k] for one in drawn], 1) for k in (0, 2))
    samples = [rows, x] if redrawn else [u]
    samples = samples if count > 1 else [one[:, 0] for one in samples]
    return ([*samples, sigma], [mapped, mapped, None]) if redrawn else (samples, [mapped])


@pytest.mark.parametrize("redrawn", [False, True])
@pytest.mark.parametrize(
    "function", [linear_map.project, kernels.project, kernels.accumulate, kernels.accumulate_squares]
)
@pytest.mark.parametrize("mapped", ["vectors", "samples", "both"])
def test_all_elements_are_mapped_by_one_call(mapped: str, function, redrawn: bool) -> None:
    samples, dims = _samples(redrawn, V if mapped != "vectors" else 1)
    dim = 1 if mapped != "samples" else None
    width = N if function in (linear_map.project, kernels.project) else 2 * S
    vectors = torch.randn(*((B, M, width) if dim is None else (B, V, M, width)), dtype=torch.float64)

    def each(vectors: torch.Tensor, *samples: torch.Tensor) -> torch.Tensor:
        return function(Redrawn(*samples, True, False) if redrawn else samples[0], vectors)

    result = torch.vmap(each, (dim, *dims))(vectors, *samples)  # a warning would fail the test
    for k in range(V):
        one = [part if d is None else part[:, k] for part, d in zip(samples, dims, strict=True)]
        torch.testing.assert_close(result[k], each(vectors if dim is None else vectors[:, k], *one))
