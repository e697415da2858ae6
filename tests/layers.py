"""Layers over closed forms, every kind of sampling, and what tests of layers have in common."""

from collections.abc import Callable

import black_boxes
import pytest
import torch
from torch import Tensor, nn

from torch_zerohess import Smoothing
from torch_zerohess.autograd import tracing
from truths import Image, spread, truths

in_graphs = pytest.mark.skipif(not tracing.GRAPHS, reason="compiled code contains a layer from torch 2.15 on")
N = 3
T = truths(N)
SCALAR, IMAGE = T["wave"], Image((T["wave"], T["exponential"], T["bump"], T["step"]))
X, V, BATCH = spread(N, -0.6, 0.7), spread(N, -1.0, 1.0), spread(4 * N, -1.0, 1.0).view(4, N)
AGGREGATE = Smoothing(sigma=spread(N, 0.3, 0.8), samples=6, seed=12)
SETTINGS = {
    "aggregate": AGGREGATE,
    "mean of the others": AGGREGATE.replace(antithetic=False, baseline="mean"),
    "gaussian": AGGREGATE.replace(proposal="gaussian", baseline="none", antithetic=False),
    "optimal": AGGREGATE.replace(proposal="optimal"),
    "uniform": AGGREGATE.replace(proposal="uniform", samples=40),
    "sobol": AGGREGATE.replace(sampler="sobol"),
    "orthogonal": AGGREGATE.replace(sampler="orthogonal"),
    "auto": Smoothing.auto(sigma=AGGREGATE.sigma, samples=24, seed=12),  # 48 Sobol points
}
EVERY = pytest.mark.parametrize("smoothing", SETTINGS.values(), ids=SETTINGS.keys())
BOTH = pytest.mark.usefixtures("memory")  # perturbations kept, and drawn again


def close(got: Tensor, expected: Tensor) -> None:
    assert got.dtype == expected.dtype
    # Rounding only; sums have about a hundred terms.
    torch.testing.assert_close(got, expected, rtol=1e-11, atol=1e-11 * (1 + float(expected.abs().max())))


class Fixed:
    """A surrogate that is never fitted."""

    def __init__(self, function: Callable[[Tensor], Tensor]) -> None:
        self.function = function

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        pass

    def __call__(self, z: Tensor) -> Tensor:
        return self.function(z)


def leaf(x: Tensor = X) -> Tensor:
    return x.clone().requires_grad_()


def network(layer: nn.Module) -> tuple[nn.Module, Tensor]:
    torch.manual_seed(3)
    before = nn.Sequential(nn.Linear(2, 5), nn.Tanh(), nn.Linear(5, N))
    after = nn.Sequential(nn.Flatten(), nn.Linear(4, 2), nn.Softplus())
    return nn.Sequential(before, layer, after).double(), spread(8, -1.0, 1.0).view(4, 2)


def counting(f):
    def fn(z: Tensor) -> Tensor:
        assert not z.requires_grad
        assert not torch.is_grad_enabled()
        return f(z)

    return black_boxes.counting(fn)
