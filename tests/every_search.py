"""Every search with a black box that keeps it busy, and when two states are the same."""

import io
from functools import partial

import pytest
import torch
from searches import rays, rays_loss, rosenbrock, zeros

from torch_zerohess.optim import (
    BlockGaussNewton,
    Descent,
    GaussianProcessSearch,
    LocalGaussNewton,
    TrustRegion,
)

# Every search with and without a loss; restarts keep it busy.
SEARCHES = {
    "descent of the loss": (Descent, 3, False),
    "descent in noise": (partial(Descent, noise=0.05, pool=80), 3, False),
    "descent of the output": (Descent, 5, True),
    "process of the loss": (GaussianProcessSearch, 2, False),
    "process of the output": (GaussianProcessSearch, 2, True),
    "block Gauss-Newton": (BlockGaussNewton, 5, True),
    "local Gauss-Newton": (LocalGaussNewton, 20, True),
    "by evidence": (TrustRegion, 20, True),
    "descent, then process": (TrustRegion, 5, True),
}


def make(name, *, seed=0, loss=None, **changes):
    """Returns the search of this name."""
    kind, n, with_loss = SEARCHES[name]
    chosen = (loss or loss_of(name)) if with_loss else None
    return kind(
        zeros(n), **{"sigma": 1.0, "bounds": (-3.0, 4.0), "restarts": 1000, "seed": seed, **changes}, loss=chosen
    )


def texels(z):
    """An output [4, 5] whose numbers depend on one of 20 parameters each."""
    return (z + 0.3 * torch.sin(z)).unflatten(1, (4, 5))


def black_box(name):
    return texels if SEARCHES[name][1] == 20 else rays if SEARCHES[name][2] else rosenbrock


def loss_of(name):
    n, with_loss = SEARCHES[name][1:]
    target = texels(torch.ones(1, 20, dtype=torch.float64))[0]
    one = (lambda output: (output - target).square().mean()) if n == 20 else rays_loss(n)
    return one if with_loss else None


def same(a, b):
    """Whether two states are equal to the last bit."""
    if isinstance(a, torch.Tensor):
        return a.dtype == b.dtype and torch.equal(a, b)
    if isinstance(a, dict):
        return isinstance(b, dict) and a.keys() == b.keys() and all(same(a[key], b[key]) for key in a)
    if isinstance(a, list):
        return len(a) == len(b) and all(same(x, y) for x, y in zip(a, b, strict=True))
    return type(a) is type(b) and a == b


every_search = pytest.mark.parametrize("name", SEARCHES)


def saved(state):
    """The state after it was written to a file and read."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    buffer.seek(0)
    return torch.load(buffer, weights_only=True)
