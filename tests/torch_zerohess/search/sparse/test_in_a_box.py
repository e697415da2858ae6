"""Dense outputs in a box: `LocalGaussNewton` says that it has arrived only at the minimum, as linear programs tell."""

import pytest
import torch
from scipy.optimize import linprog, lsq_linear

import torch_zerohess as zh

LOSSES = {
    "magnitudes": lambda y: y.abs().mean(),
    "largest": lambda y: y.abs().max(),
    "squares": lambda y: y.square().mean(),
}


def problem(n, seed, m):
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(m, n, generator=generator, dtype=torch.float64)
    wanted = 1.5 * torch.randn(n, generator=generator, dtype=torch.float64)
    b = a @ wanted + 0.5 * torch.randn(m, generator=generator, dtype=torch.float64)
    return a, b, 0.9 * (2.0 * torch.rand(n, generator=generator, dtype=torch.float64) - 1.0)


def least(name, a, b):
    """The minimum in the box [-1, 1]."""
    (m, n), one = a.shape, torch.eye(len(a), dtype=a.dtype)
    if name == "squares":
        return 2.0 * lsq_linear(a.numpy(), b.numpy(), (-1, 1), tol=1e-14).cost / m
    slack = one if name == "magnitudes" else one.sum(1, keepdim=True)
    weights = torch.ones(slack.shape[1], dtype=a.dtype) / slack.shape[1]
    rows = torch.cat([torch.cat([a, -slack], 1), torch.cat([-a, -slack], 1)])
    cost = torch.cat([torch.zeros(n, dtype=a.dtype), weights])
    limits = [(-1, 1)] * n + [(0, None)] * len(weights)
    return linprog(cost.numpy(), rows.numpy(), torch.cat([b, -b]).numpy(), bounds=limits).fun


@pytest.mark.parametrize(("name", "n", "seed"), [("magnitudes", 6, 0), ("largest", 5, 1), ("squares", 16, 2)])
def test_the_minimum_in_a_box_is_found(name, n, seed):
    a, b, x0 = problem(n, seed, 2 * n)
    loss = LOSSES[name]
    fit = zh.minimize(
        lambda x: x @ a.mT - b, x0, sigma=0.5, bounds=(-1, 1), loss=loss, engine="local", restarts=0, seed=seed
    )
    assert fit.success
    assert fit.value - least(name, a, b) < 1e-4 * float(fit.values[0])
    assert fit.evaluations < 200


@pytest.mark.parametrize("seed", [1, 3])
def test_where_outputs_bend_it_looks_again_before_it_says_that_it_has_arrived(seed):
    """At the minimum of squares in the box the projected slope vanishes."""
    a, b, x0 = problem(16, seed, 32)
    turned = torch.randn(32, 16, generator=torch.Generator().manual_seed(9), dtype=torch.float64) / 4.0
    squares = LOSSES["squares"]

    def bent(x):
        return x @ a.mT + 0.4 * (x @ turned.mT).sin() - b

    fit = zh.minimize(bent, x0, sigma=0.5, bounds=(-1, 1), loss=squares, engine="local", restarts=0, seed=seed)
    slope = torch.func.grad(lambda x: squares(bent(x[None])[0]))(fit.x)
    projected = fit.x - (fit.x - slope / slope.norm()).clamp(-1, 1)
    assert fit.success
    assert float(projected.norm()) < 0.01
