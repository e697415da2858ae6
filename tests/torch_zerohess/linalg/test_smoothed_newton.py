"""Minima of losses with kinks against linear programs, medians and least squares."""

import math

import pytest
import torch
from scipy.optimize import linprog

from torch_zerohess.linalg import smoothed_newton
from torch_zerohess.linalg.krylov import krylov_steps
from torch_zerohess.linalg.smoothed_newton import LinearOutputs, smoothed_minimum
from truths import magnitudes, normal, vector

M, N = 60, 30
A, Y = normal(M, N), normal(M, seed=1)


def outputs(loss, matrix=A, y=Y, calls=None):
    def valued(output):
        if calls is not None:
            calls.append(output)
        with torch.enable_grad():
            z = output.clone().requires_grad_(True)
            value = loss(z)
            (slope,) = torch.autograd.grad(value, z)
        return float(value.detach()), torch.nan_to_num(slope)

    return LinearOutputs(valued, y, lambda s: matrix @ s, lambda w: matrix.mT @ w)


def minimum(loss, radius=100.0, bound=math.inf, matrix=A, y=Y, calls=None):
    every = vector(bound).expand(matrix.shape[1])
    widths = matrix.square().sum(1).sqrt() * radius / matrix.shape[1] ** 0.5
    start = torch.zeros_like(every)
    return smoothed_minimum(outputs(loss, matrix, y, calls), widths, radius, -every, every, start)


def least_magnitudes(bound):
    """The exact minimum of the sum of magnitudes, by a linear program."""
    eye = torch.eye(M).double()
    both = torch.cat([torch.cat([A, -eye], 1), torch.cat([-A, -eye], 1)])
    costs = torch.cat([torch.zeros(N), torch.ones(M)])
    sides = [(-bound, bound)] * N + [(0, None)] * M
    return linprog(costs.numpy(), A_ub=both.numpy(), b_ub=torch.cat([-Y, Y]).numpy(), bounds=sides).fun


@pytest.mark.parametrize("bound", [0.1, 100.0])
def test_a_sum_of_magnitudes_falls_to_its_minimum(bound):
    """To two hundredths of the decrease, within 400 evaluations of the loss; bounds hold parameters."""
    calls = []
    s, gain = minimum(magnitudes, bound=bound, calls=calls)
    assert float(s.abs().max()) <= bound
    assert gain == pytest.approx(float(magnitudes(Y) - magnitudes(Y + A @ s)))
    assert gain == pytest.approx(float(magnitudes(Y)) - least_magnitudes(bound), rel=2e-2)
    assert len(calls) < 400


def test_a_sum_of_magnitudes_that_can_vanish():
    """More parameters than outputs: the last widths are far below the first ones."""
    wide = normal(N, M)
    s, _ = minimum(magnitudes, radius=3.0, matrix=wide, y=Y[:N])
    assert float(magnitudes(Y[:N] + wide @ s)) < 4e-3 * float(magnitudes(Y[:N]))


def test_the_median():
    """Of each parameter's five numbers."""
    eye = torch.eye(20).double().repeat(5, 1)
    targets = normal(5, 20, seed=2)
    s, _ = minimum(lambda y: (y - targets.flatten()).abs().mean(), radius=20.0, matrix=eye, y=torch.zeros(100).double())
    torch.testing.assert_close(s, targets.median(0).values, atol=0.02, rtol=0.0)


@pytest.mark.parametrize("radius", [0.3, 100.0])
def test_a_norm_has_the_minimum_of_its_square(radius):
    """Its second derivative is no diagonal. It has no kink here, so little smoothing is not tried."""
    calls = []
    s, _ = minimum(lambda y: y.norm(), radius=radius, calls=calls)
    assert len(calls) < 230
    expected = krylov_steps(lambda v: A.mT @ (A @ v), A.mT @ Y, vector(radius), iterations=N)[0]
    assert float(s.norm()) <= radius * (1 + 1e-9)
    assert float((Y + A @ s).norm()) == pytest.approx(float((Y + A @ expected).norm()), rel=1e-3)


def test_the_largest_magnitude_falls():
    """Where all but one element have the slope zero."""
    s, _ = minimum(lambda y: y.abs().max(), radius=10.0)
    assert float((Y + A @ s).abs().max()) < 0.5 * float(Y.abs().max())


def test_magnitudes_of_differences():
    """Outputs that are moved by equal offsets would not change them."""
    square = torch.linalg.qr(normal(N, N)).Q
    s, _ = minimum(lambda y: y.diff().abs().sum(), radius=10.0, matrix=square, y=Y[:N])
    assert float((Y[:N] + square @ s).diff().abs().sum()) < 0.1 * float(Y[:N].diff().abs().sum())


def test_no_step_leads_away_from_a_minimum():
    s, gain = minimum(magnitudes, y=torch.zeros(M).double())
    assert gain == 0.0
    assert not s.any()


def test_a_start_is_improved_although_much_smoothing_leads_away_from_it():
    """The first widths are a thousand times what is left to go."""
    best, gain = minimum(magnitudes)
    every, widths = vector(math.inf).expand(N), A.square().sum(1).sqrt() * 100.0 / N**0.5
    s, more = smoothed_minimum(outputs(magnitudes), widths, 100.0, -every, every, 0.95 * best)
    assert more >= 0.99 * gain
    assert more == pytest.approx(float(magnitudes(Y) - magnitudes(Y + A @ s)))


def test_an_output_that_nothing_moves_has_no_width():
    """Its slopes count once, and its second derivative is not 0 / 0."""
    matrix = torch.cat([A, torch.zeros(1, N).double()])
    s, _ = minimum(magnitudes, matrix=matrix, y=torch.cat([Y, vector(3.0)]))
    assert float(magnitudes(Y + A @ s)) == pytest.approx(least_magnitudes(100.0), rel=1e-2)


def test_values_that_are_not_finite_are_avoided():
    """A logarithm whose argument would be negative at the end of the first step."""
    s, gain = minimum(lambda y: y.square().mean() - (4.0 - y).log().mean(), radius=1e3)
    assert gain > 0.0
    assert bool((Y + A @ s < 4.0).all())


def test_steps_are_solved_by_many_products(monkeypatch):
    """Sizes of parameters differ by a factor of ten."""
    sized = A * torch.linspace(1.0, 10.0, N).double()
    _, gain = minimum(magnitudes, matrix=sized)
    monkeypatch.setattr(smoothed_newton, "_PRODUCTS", 3)
    assert minimum(magnitudes, matrix=sized)[1] < gain
