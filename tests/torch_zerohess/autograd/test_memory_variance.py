"""The variance of gradients with a memory against a closed form."""

import pytest
import torch
from layers import Fixed
from torch import Tensor

import torch_zerohess as zh

SLOPE = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
RESIDUAL = torch.tensor([0.3, -0.4, 0.1], dtype=torch.float64)
"""Slope d of f - g."""
SIGMA, SAMPLES = 0.5, 3


def remembering(fresh: int | None) -> zh.Memory:
    """A memory whose surrogate is affine, with the slope of f but for d, and a coefficient of 1."""
    memory = zh.Memory(Fixed(lambda z: z @ (SLOPE - RESIDUAL) - 2.0), fresh=fresh)
    memory.add(torch.zeros(2, 3, dtype=torch.float64), torch.ones(2, dtype=torch.float64))
    memory.fit()
    memory.regression.moments = [[1.0, 1.0]]
    return memory


@pytest.mark.parametrize("share", [1, 2])
def test_a_linear_residual_has_a_known_variance(share: int) -> None:
    """Gradients of 20 000 elements, of which one in `share` has new samples.

    A pair of normal samples says u_i (d.u) of element i of the gradient of f - g. Its mean is d_i and its variance
    |d|^2 + d_i^2. The gradient of the surrogate's term is exact. An element with new samples, which has the weight
    `share`, is one of `share` elements: the variance is then share (v + d_i^2) - d_i^2 for a variance v with new
    samples.
    """
    batch = 20_000
    x = torch.zeros(batch, 3, dtype=torch.float64, requires_grad=True)
    smoothing = zh.Smoothing(sigma=SIGMA, samples=SAMPLES, proposal="gaussian", baseline="none", order=1, seed=0)
    memory = remembering(batch // share)
    layer = zh.BlackBox(lambda z: z @ SLOPE + 7.0, smoothing, memory=memory, value="smoothed").eval()
    (gradient,) = torch.autograd.grad(layer(x).sum(), x)

    def variance(d: Tensor) -> Tensor:
        new = (d.square().sum() + d.square()) / SAMPLES
        return share * (new + d.square()) - d.square()

    squares = (gradient - SLOPE).square()
    error = squares.std(0) / batch**0.5
    z = (squares.mean(0) - variance(RESIDUAL)) / error
    assert float(z.abs().max()) < 5, "of 3 numbers; false alarms: 1 in 500 000"
    assert bool((error < 0.05 * variance(RESIDUAL)).all())
    assert bool((variance(SLOPE) > 10.0 * variance(RESIDUAL)).all())  # without the surrogate
