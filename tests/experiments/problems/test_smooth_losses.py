"""Smooth losses: convexity, minima of closed forms, and tasks whose targets are shares of the first gap."""

import pytest
import torch

from experiments.problems.smooth_losses import FUNCTIONS, NAMES, TARGETS, functions, lowest, minimizer, task

CONVEX = NAMES[:-1]


@pytest.mark.parametrize("name", CONVEX)
def test_losses_are_convex(name):
    function = functions(3, 1)[name]
    a, b = 5 * torch.randn(2, 200, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    assert bool((function(0.5 * (a + b)) < 0.5 * (function(a) + function(b))).all())


def test_the_last_loss_is_convex_near_its_minimum_only():
    function = functions(3, 1)[NAMES[-1]]
    x = minimizer(function, 3)
    hessian = torch.func.hessian(lambda z: function(z[None])[0])
    assert bool((torch.linalg.eigvalsh(hessian(x)) > 0).all())
    assert bool((torch.linalg.eigvalsh(hessian(x + 9.0)) < 0).any())


def test_minima_are_those_of_closed_forms():
    known = {
        "sphere": pytest.approx(0.0, abs=1e-20),
        "log cosh, condition 100": pytest.approx(0.0, abs=1e-14),
        "exponentials": pytest.approx(4 * (2 ** (1 / 3) + 2 ** (-2 / 3)), rel=1e-14),
        "pseudo-Huber": pytest.approx(4.0, rel=1e-14),
        "quartic": pytest.approx(0.0, abs=1e-20),
        "log(1 + u^2)": pytest.approx(0.0, abs=1e-20),
    }
    made = functions(4, 5)
    assert {name: lowest(made[name], 4) for name in known} == known


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n", [2, 7])
def test_slopes_are_zero_at_minima(name, n):
    function = functions(n, 2)[name]
    slope = torch.func.grad(lambda z: function(z[None])[0])
    assert float(slope(minimizer(function, n)).norm()) < 1e-7 * float(slope(torch.full((n,), 3.0).double()).norm())


@pytest.mark.parametrize("number", FUNCTIONS)
def test_the_first_gap_is_one(number):
    made = task(number, 3, 2, 100)
    assert made.title == NAMES[number - 1]
    assert float(made.loss(made.start(0)[None])[0]) == pytest.approx(1.0, rel=1e-9)
    x = minimizer(functions(2, 3)[made.title], 2)
    assert abs(float(made.loss(x[None])[0])) < 0.01 * TARGETS[-1]
