"""Squared distances of a process to outputs, and their derivatives, against torch.func of the process itself."""

import pytest
import torch

from torch_zerohess.surrogates import squared_distance
from torch_zerohess.surrogates.inducing import InducedProcess
from torch_zerohess.surrogates.kernels import KERNELS, gaussian
from torch_zerohess.surrogates.squared_distance import SquaredDistance
from truths import normal, vector

B, Q, m = 3, 100, 4
"""300 points: more than are held at once, and no multiple of them."""


@pytest.mark.parametrize("n", [1, 3])
@pytest.mark.parametrize("kernel", KERNELS)
def test_values_and_two_derivatives_are_those_of_the_process(kernel, n):
    assert B * Q > squared_distance._ROWS
    points, lengths, y = 2.0 * normal(40, n), vector(0.5, 1.0, 2.0)[:n], normal(B, m, seed=1)
    process = InducedProcess.condition(points / lengths, (points @ normal(n, m, seed=2)).sin(), kernel, 1e-3)
    squares, z = SquaredDistance(process, lengths, y, vector(0.0, 1.0, 2.0)), normal(B, Q, n, seed=3)

    def one(at, its):
        return (process(at[None] / lengths)[0] - its).square().sum()

    pairs = z.flatten(0, 1), y.repeat_interleave(Q, 0)
    values = torch.func.vmap(one)(*pairs).view(B, Q) + vector(0.0, 1.0, 2.0)[:, None]
    found = squares.first(z)
    torch.testing.assert_close(found.values, values, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(squares.general(z), values, rtol=1e-9, atol=1e-9)
    gradient = torch.func.vmap(torch.func.grad(one))(*pairs).view(B, Q, n)
    torch.testing.assert_close(found.gradient, gradient, rtol=1e-8, atol=1e-8)
    hessian = torch.func.vmap(torch.func.hessian(one))(*pairs).view(B, Q, n, n)
    torch.testing.assert_close(squares.hessian(z, found.pulled), hessian, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_at_a_chosen_point_derivatives_are_finite(kernel):
    points = normal(10, 2)
    process = InducedProcess.condition(points, points.sin(), kernel, 1e-3)
    squares = SquaredDistance(process, vector(1.0, 1.0), normal(1, 2, seed=1), vector(0.0))
    z = process.points[None, :3]
    at, beside = (squares.first(one) for one in (z, z + 1e-6))
    torch.testing.assert_close(at.gradient, beside.gradient, atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(
        squares.hessian(z, at.pulled), squares.hessian(z + 1e-6, beside.pulled), atol=1e-2, rtol=0
    )


def test_where_no_point_is_chosen_the_mean_is_compared():
    points, y = normal(25, 2), normal(1, 2, seed=1)
    process = InducedProcess.condition(points, points.sin(), gaussian, 1e6)
    assert len(process.points) == 0
    squares, z = SquaredDistance(process, vector(1.0, 1.0), y, vector(0.0)), normal(1, 5, 2)
    found = squares.first(z)
    torch.testing.assert_close(found.values, (points.sin().mean(0) - y).square().sum().expand(1, 5))
    assert not found.gradient.any()
    assert not squares.hessian(z, found.pulled).any()
