"""Gradients that need a learned function h: of h itself (ZeroGrads), and with h as a control variate (LAX)."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

Function = Callable[[Tensor], Tensor]
"""[K, n] -> [K], differentiable."""


def network(inputs: int, hidden: Sequence[int], activation: type[nn.Module], seed: int) -> nn.Sequential:
    """Return layers from `inputs` numbers to one, float64, the same for the same seed."""
    layers: list[nn.Module] = []
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        for width in hidden:
            layers += [nn.Linear(inputs, width), activation()]
            inputs = width
        layers += [nn.Linear(inputs, 1), nn.Flatten(0)]
        return nn.Sequential(*layers).double()


def lax(f: Tensor, h: Function, x: Tensor, u: Tensor, sigma: float) -> Tensor:
    """Return a LAX estimate [K, n] per sample of the gradient of E f(x + sigma u), differentiable in the weights of h.

    (f - h(z)) u / sigma + grad h(z) at z = x + sigma u (Grathwohl et al. 2018, equation 4): the score function of what
    h leaves of f, and the pathwise gradient of h. Unbiased for every h that does not depend on u.

    Args:
        f: values [K] at z.
        h: control variate.
        x: centres [n] or [K, n].
        u: standard normal [K, n].
        sigma: of the smoothing.
    """
    z = (x + sigma * u).detach().requires_grad_()
    value = h(z)
    (slope,) = torch.autograd.grad(value.sum(), z, create_graph=True)
    return (f - value)[:, None] * u / sigma + slope


def fit(h: Function, optimizer: torch.optim.Optimizer, z: Tensor, f: Tensor, steps: int) -> None:
    """Take steps of an optimizer on the mean squared error of h at z [K, n], whose values are f [K]."""
    for _ in range(steps):
        optimizer.zero_grad()
        (h(z) - f).square().mean().backward()
        optimizer.step()


def slope(h: Function, x: Tensor) -> Tensor:
    """Return the gradient [K, n] of h at x [K, n]."""
    x = x.detach().requires_grad_()
    return torch.autograd.grad(h(x).sum(), x)[0]
