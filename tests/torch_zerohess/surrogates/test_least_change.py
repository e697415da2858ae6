"""The quadratic of least change against closed forms and against a direct minimisation of the change."""

import math

import pytest
import torch

from torch_zerohess.surrogates.least_change import (
    Interpolation,
    LeastNorm,
    least_change,
    least_change_of_transform,
)
from torch_zerohess.surrogates.loss_transform import LossTransform
from truths import vector


def quadratic(n, seed):
    generator = torch.Generator().manual_seed(seed)
    g = torch.randn(n, generator=generator, dtype=torch.float64)
    H = torch.randn(n, n, generator=generator, dtype=torch.float64)
    H = H + H.mT
    return g, H, lambda u: 2.0 + u @ g + 0.5 * ((u @ H) * u).sum(1)


def points(P, n, seed):
    return torch.randn(P, n, generator=torch.Generator().manual_seed(100 + seed), dtype=torch.float64)


@pytest.mark.parametrize("n", [1, 2, 5])
@pytest.mark.parametrize("more", [0, 4])
def test_a_quadratic_is_recovered(n, more):
    g, H, f = quadratic(n, n)
    u = points((n + 1) * (n + 2) // 2 + more, n, n)
    value, gradient, hessian = least_change(u, f(u), torch.zeros(n, n, dtype=torch.float64))
    assert value == pytest.approx(2.0, abs=1e-3)
    torch.testing.assert_close(gradient, g, rtol=0, atol=1e-3)
    torch.testing.assert_close(hessian, H, rtol=0, atol=1e-3)


def test_the_true_hessian_stays_and_few_points_are_enough_for_the_slope():
    g, H, f = quadratic(4, 1)
    u = points(5, 4, 1)
    _, gradient, hessian = least_change(u, f(u), H)
    torch.testing.assert_close(gradient, g, rtol=0, atol=1e-6)
    torch.testing.assert_close(hessian, H, rtol=0, atol=1e-6)


def test_few_points_tell_the_slope_along_them():
    """Two values determine a slope or a curvature: nearly all of their difference is a slope."""
    u = vector(0.0, 1.0)[:, None] * vector(3.0, 4.0, 0.0) / 5
    _, gradient, _ = least_change(u, vector(0.0, 2.0), u.new_zeros(3, 3))
    torch.testing.assert_close(gradient, 2.0 * vector(0.6, 0.8, 0.0), rtol=0, atol=0.05)


@pytest.mark.parametrize(("n", "P", "scaled", "size"), [(3, 8, 1e-12, 1.0), (5, 12, 10.0, 0.01)])
def test_no_smaller_change_interpolates(n, P, scaled, size):
    """The change is C + a I + b H of least |C|^2 / 2 + a^2 + b^2 / scaled, H the earlier Hessian with the norm of I.

    Its derivatives vanish along all changes that no value sees. Few values count as exact only close to 0.
    """
    _, _, f = quadratic(n, 2)
    u = size * points(P, n, 2)
    earlier = torch.diag(torch.arange(1.0, n + 1).double())
    value, gradient, hessian = least_change(u, f(u), earlier)
    fitted = value + u @ gradient + 0.5 * ((u @ hessian) * u).sum(1)
    torch.testing.assert_close(fitted, f(u), rtol=0, atol=1e-5)
    pairs = [(i, j) for i in range(n) for j in range(i + 1)]
    columns = [u.new_ones(P), *u.mT, *(u[:, i] * u[:, j] * (0.5 if i == j else 1.0) for i, j in pairs)]
    design = torch.stack(columns, 1)
    change = hessian - earlier
    common = torch.stack([torch.eye(n, dtype=torch.float64), n**0.5 * earlier / earlier.norm()]).flatten(1)
    penalty = torch.diag(torch.tensor([2.0, 2.0 / scaled], dtype=torch.float64))
    factors = torch.linalg.solve(common @ common.mT + penalty, common @ change.flatten())  # a and b, given the change
    own = change - (factors @ common).reshape(n, n)
    _, _, rows = torch.linalg.svd(design)
    for free in rows[P:]:  # changes of the coefficients that no value sees
        matrix = u.new_zeros(n, n)
        for k, (i, j) in enumerate(pairs):
            matrix[i, j] = matrix[j, i] = free[1 + n + k]
        assert abs(float((own * matrix).sum())) < 1e-4


def test_a_change_of_all_curvatures_is_learned_from_few_values():
    """Twelve values of |u|^2 in ten dimensions; the earlier Hessian is half of the true one.

    Eleven values determine the constant and the slope. The twelfth is about the curvature along one axis. The change of
    this curvature counts for all axes, also where there is no earlier Hessian: the error of the Hessian is 0.61 of the
    true one, and 0.94 if the change counts for this axis alone.
    """
    u = torch.cat([torch.zeros(1, 10), torch.eye(10), -torch.eye(10)[:1]]).double()
    identity = torch.eye(10, dtype=torch.float64)
    _, _, hessian = least_change(u, 0.5 * u.square().sum(1), torch.zeros_like(identity))
    assert float((hessian - identity).norm()) < 0.85 * float(identity.norm())


def test_a_common_factor_of_all_curvatures_is_learned_from_few_values():
    """Twelve values of a quadratic in ten dimensions, condition 100; the earlier Hessian is twice the true one.

    Eleven values determine the constant and the slope. The twelfth tells half of the largest curvature. If its change
    counts as a factor, the error of the Hessian is 0.03 of the true one, and 0.59 otherwise.
    """
    u = torch.cat([torch.zeros(1, 10), torch.eye(10), -torch.eye(10)[-1:]]).double()
    true = torch.diag(torch.logspace(-2, 0, 10, dtype=torch.float64))
    _, _, hessian = least_change(u, 0.5 * ((u @ true) * u).sum(1), 2 * true)
    assert float((hessian - true).norm()) < 0.1 * float(true.norm())


def test_near_points_count_more():
    """Of |u|^3 along a line the slope at 0 is 0; far points alone would tilt it."""
    u = torch.tensor([0.0, 0.1, -0.1, 0.2, -0.2, 3.0], dtype=torch.float64)[:, None]
    _, gradient, _ = least_change(u, u[:, 0] ** 3 / 27, torch.zeros(1, 1, dtype=torch.float64))
    assert abs(float(gradient)) < 0.01


@pytest.mark.parametrize("seed", [1, 5])
def test_values_tell_a_quadratic_from_a_rougher_function(seed):
    """The slope at 0 is (1, ..., 1). Quadratics through all values of the rougher function miss it by 3 to 4."""
    n = 6
    generator = torch.Generator().manual_seed(seed)
    A = torch.randn(n, n, generator=generator, dtype=torch.float64)
    u = torch.randn(30, n, generator=generator, dtype=torch.float64)
    u[22:] *= 0.1
    u = torch.cat([u.new_zeros(1, n), u])
    nothing = u.new_zeros(n, n)
    for values, most in (
        (u.sum(1) + 0.5 * (u @ A).square().sum(1), 1e-3),
        (u.sum(1) + 0.5 * u.square().sum(1) + 0.3 * u.sum(1) ** 3, 2.5),
    ):
        size = float(values.abs().max())
        _, gradient, _ = least_change(u, values / size, nothing)
        assert float((size * gradient - 1).norm()) < most


@pytest.mark.parametrize("P", [3, 5, 10, 14])
def test_the_jacobian_against_a_direct_minimisation(P):
    """Least |H|^2 / 2 + sum of squared misfits / (10^-3 |u|^6), over all slopes and Hessians of each output."""
    n, m = 3, 2
    u = 0.5 * points(P, n, 3)
    changes = torch.stack([torch.sin(u @ torch.arange(1.0, 4.0).double()), u.square().sum(1) + u[:, 0]], 1)
    pairs = [(i, j) for i in range(n) for j in range(i + 1)]
    bends = [u[:, i] * u[:, j] * (0.5 if i == j else 0.5**0.5) for i, j in pairs]  # of norm one
    weight = 1e-3**-0.5 / u.norm(dim=1, keepdim=True).pow(3)
    design = torch.cat([u, torch.stack(bends, 1)], 1) * weight
    penalty = torch.diag(torch.cat([torch.zeros(n), torch.full((len(bends),), 0.5**0.5)]).double())
    padded = torch.cat([changes * weight, u.new_zeros(len(penalty), m)])
    direct = torch.linalg.lstsq(torch.cat([design, penalty]), padded, driver="gelsd").solution
    found = LeastNorm.through(u, changes)
    torch.testing.assert_close(found.jacobian, direct[:n], rtol=1e-4, atol=1e-4)
    slope = vector(2.0, -3.0)
    hessian = u.new_zeros(n, n)
    for (i, j), one in zip(pairs, direct[n:] @ slope, strict=True):
        hessian[i, j] = hessian[j, i] = one * (1.0 if i == j else 0.5**0.5)
    torch.testing.assert_close(found.hessian(slope), hessian, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("P", [1, 2])
def test_few_points_tell_the_jacobian_along_them(P):
    slopes = points(4, 2, 5)
    u = torch.eye(4, dtype=torch.float64)[:P]
    expected = torch.cat([slopes[:P], torch.zeros(4 - P, 2, dtype=torch.float64)])
    torch.testing.assert_close(LeastNorm.through(u, u @ slopes).jacobian, expected, rtol=0, atol=1e-6)


def test_where_all_points_round_to_the_center_the_jacobian_is_zero():
    u = torch.zeros(3, 2, dtype=torch.float64)
    assert not LeastNorm.through(u, u).jacobian.any()


@pytest.mark.parametrize("kind", ["square", "logarithm"])
@pytest.mark.parametrize("shift", [20 / 1.5**4, 20 / 1.5**12, 20 / 1.5**20])
@pytest.mark.parametrize("n", [2, 5])
def test_the_transform_that_losses_were_made_with_is_the_likeliest(kind, shift, n):
    """Losses up to 1 whose square or logarithm with this shift, one of those to choose from, is a quadratic."""
    u = points((n + 1) * (n + 2) // 2 + n, n, n)
    u[0] = 0.0
    A = torch.randn(n, n, generator=torch.Generator().manual_seed(n), dtype=torch.float64)
    H = A @ A.mT + torch.eye(n, dtype=torch.float64)
    quadratic = ((u @ H) * u).sum(1)
    highest = (1.0 + shift) ** 2 / (2 * shift) - shift / 2 if kind == "square" else shift * math.log1p(1.0 / shift)
    quadratic, H = quadratic * highest / quadratic.max(), 2.0 * H * highest / quadratic.max()
    losses = (
        (shift**2 + 2 * shift * quadratic).sqrt() - shift if kind == "square" else shift * (quadratic / shift).expm1()
    )
    transform, gradient, hessian = least_change_of_transform(u, losses, torch.zeros_like(H), None)
    assert (transform.kind, transform.shift) == (kind, pytest.approx(shift))
    torch.testing.assert_close(gradient, torch.zeros_like(gradient), rtol=0, atol=1e-3 * float(H.norm()))
    torch.testing.assert_close(hessian, H, rtol=0, atol=1e-3 * float(H.norm()))
    assert transform.inverse(0.5 * float(u[3] @ hessian @ u[3])) == pytest.approx(float(losses[3]), rel=1e-2)


def test_the_hessian_of_an_earlier_square_is_told_to_a_later_one():
    """Two points more than the slopes need; the Hessian of a square with three times the shift is a third of it."""
    n = 5
    u = points(2 * n + 1, n, 3)
    u[0] = 0.0
    H = torch.diag(vector(1.0, 2.0, 3.0, 4.0, 5.0))
    shift = 20 / 1.5**12
    quadratic = ((u @ H) * u).sum(1)
    highest = (1.0 + shift) ** 2 / (2 * shift) - shift / 2
    losses = (shift**2 + 2 * shift * quadratic * highest / quadratic.max()).sqrt() - shift
    true = 2.0 * H * highest / float(quadratic.max())
    found = [
        least_change_of_transform(u, losses, told, earlier)[2]
        for told, earlier in [(true / 3, LossTransform("square", 3 * shift)), (true, LossTransform("square", shift))]
    ]
    torch.testing.assert_close(found[0], found[1])


@pytest.mark.parametrize("n", [2, 4, 5])
def test_quadratics_at_the_same_points_share_what_they_can(n):
    """Up to four parameters the processes are the same ones for every earlier Hessian. Results have the same bits."""
    u, (_, H, f) = points(20, n, n), quadratic(n, n)
    shared = Interpolation(u)
    before = shared.processes(torch.zeros_like(H))
    assert all(one is other for one, other in zip(before, shared.processes(H), strict=True)) is (n <= 4)
    for alone, other in zip(
        least_change(u, f(u).sin(), H)[1:], least_change(u, f(u).sin(), H, shared)[1:], strict=True
    ):
        assert torch.equal(alone, other)
    losses = f(u).cosh() - 1.0
    alone, other = (least_change_of_transform(u, losses, H, None, one) for one in (None, shared))
    assert alone[0] == other[0]
    assert torch.equal(alone[2], other[2])
