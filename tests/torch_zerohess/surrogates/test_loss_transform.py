"""Transforms of losses against their closed forms and derivatives by `torch.func`."""

import math

import pytest
import torch

from torch_zerohess.surrogates.loss_transform import LossTransform, transformed, warped
from truths import vector


def forward(one: LossTransform, v):
    c = one.shift
    return ((v + c) ** 2 - c**2) / (2 * c) if one.kind == "square" else c * torch.log1p(v / c)


def test_columns_are_squares_and_logarithms_and_their_inverse_is_the_loss():
    values = vector(0.0, 1e-3, 0.1, 1.0)
    transforms, columns, _ = transformed(values)
    assert {one.kind for one in transforms} == {"square", "logarithm"}
    for one, column in zip(transforms, columns.mT, strict=True):
        torch.testing.assert_close(column, forward(one, values), rtol=1e-12, atol=1e-15)
        back = vector(*(one.inverse(float(y)) for y in column))
        torch.testing.assert_close(back, values, rtol=1e-10, atol=1e-13)


def test_mean_slopes_leave_out_the_lowest_loss():
    values = vector(0.0, 0.02, 0.3, 1.0)
    transforms, _, means = transformed(values)
    for one, mean in zip(transforms, means, strict=True):
        slopes = torch.func.vmap(torch.func.grad(lambda v, one=one: forward(one, v)))(values[1:])
        assert float(mean) == pytest.approx(float(slopes.log().mean()), rel=1e-10)


def test_less_than_every_square_is_minus_the_shift_and_logarithms_do_not_overflow():
    assert LossTransform("square", 0.5).inverse(-0.3) == -0.5
    assert LossTransform("square", 0.5).inverse(-0.25) == pytest.approx(-0.5, abs=1e-7)
    assert math.isfinite(LossTransform("logarithm", 1e-3).inverse(1e9))
    assert LossTransform("logarithm", 1e-3).inverse(-1e9) == -1e-3


def test_the_ratio_of_hessians_of_squares_of_one_cone():
    """Squares (v + c)^2 / (2 c) of a cone |x| have the Hessian I / c: of v = |x| - 1 the shift is 1."""
    x = vector(0.3, -0.7)
    hessians = [torch.func.hessian(lambda x, c=c: (x.square().sum().sqrt() ** 2) / (2 * c))(x) for c in (1.0, 0.2)]
    one, other = LossTransform("square", 1.0), LossTransform("square", 0.2)
    torch.testing.assert_close(other.hessian_ratio(one) * hessians[0], hessians[1])
    assert other.hessian_ratio(LossTransform("logarithm", 1.0)) == 1.0


def test_warped_values_are_the_values_below_the_unit_and_logarithms_beyond():
    v = vector(-0.01, 0.0, 0.01, 1e3, 1e200)
    v.requires_grad_()
    y, slopes = warped(v, 1.0)
    torch.testing.assert_close(
        y, vector(-0.01, 0.0, 0.01, math.log(2e3), math.log(2.0) + 200 * math.log(10.0)), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(slopes[:4], torch.autograd.grad(y.sum(), v)[0][:4])
    assert torch.equal(warped(v, math.inf)[0], v)
