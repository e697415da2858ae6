"""Local models against quadratics, quadrature and torch.func."""

import math

import numpy as np
import pytest
import torch
from searches import sum_of_squares

from torch_zerohess.surrogates.loss_curvature import loss_curvature, value_and_slope
from torch_zerohess.surrogates.quadratic import fit_outputs, fit_values
from truths import vector


def normal(generator, *shape):
    return torch.randn(*shape, dtype=torch.float64, generator=generator)


def random_quadratic(n, generator):
    A, b = normal(generator, n, n), normal(generator, n)
    A = A + A.mT
    return A, b, lambda u: 0.7 + u @ b + 0.5 * ((u @ A) * u).sum(1)


@pytest.mark.parametrize("n", [1, 2, 5])
@pytest.mark.parametrize("offset", [0.0, 1e6])
@pytest.mark.parametrize("scale", [1e-100, 1.0, 1e100])
def test_quadratics_are_exact(n, offset, scale):
    generator = torch.Generator().manual_seed(n)
    A, b, f = random_quadratic(n, generator)
    u = normal(generator, (n + 1) * (n + 2) // 2 + 3, n)
    weights = 0.1 + torch.rand(len(u), dtype=torch.float64, generator=generator)
    model = fit_values(u, scale * (f(u) + offset), weights)
    assert model.value / scale - offset == pytest.approx(0.7, abs=1e-3)
    torch.testing.assert_close(model.full_gradient() / scale, b, rtol=0, atol=1e-3)
    torch.testing.assert_close(model.full_hessian() / scale, A, rtol=0, atol=1e-3)
    assert model.significance > 0
    s = normal(generator, n)
    assert model.decrease(s) / scale == pytest.approx(float(f(torch.zeros_like(u[:1])) - f(s[None])), rel=1e-2)


def test_an_offset_of_1e12_times_the_variation():
    generator = torch.Generator().manual_seed(0)
    A, b, f = random_quadratic(3, generator)
    u = normal(generator, 40, 3)
    model = fit_values(u, 1e12 + f(u), torch.ones(40, dtype=torch.float64))
    # The values themselves are rounded to 1e-4.
    torch.testing.assert_close(model.full_gradient(), b, rtol=0, atol=1e-3)
    torch.testing.assert_close(model.full_hessian(), A, rtol=0, atol=1e-3)


def test_consistent_for_what_is_not_a_quadratic():
    """Hermite coefficients of exp(a.u) cos(c.u_0) by Gauss-Hermite quadrature against fits to 400 samples.

    Mean of 150 fits with antithetic samples, weights 1: within 5 standard errors (false alarms: 5 elements times
    6e-7) and a ridge's shrinking of 1 %.
    """

    def f(u):
        return torch.exp(0.3 * u[:, 0] - 0.4 * u[:, 1]) * torch.cos(0.8 * u[:, 0])

    nodes, mass = (torch.from_numpy(one) for one in np.polynomial.hermite_e.hermegauss(40))
    grid = torch.cartesian_prod(nodes, nodes)
    mass = torch.outer(mass, mass).flatten() / (2 * math.pi)
    terms = [grid[:, 0], grid[:, 1], grid[:, 0] ** 2 - 1, grid[:, 1] ** 2 - 1, grid[:, 0] * grid[:, 1]]
    truth = torch.stack([(mass * f(grid) * term).sum() for term in terms])
    generator = torch.Generator().manual_seed(0)
    fits = []
    for _ in range(150):
        u = normal(generator, 400, 2)
        model = fit_values(u, f(u), torch.ones(400, dtype=torch.float64))
        H = model.full_hessian()
        fits.append(torch.cat([model.full_gradient(), H.diagonal(), H[0, 1:]]))
    fits = torch.stack(fits)
    error = (fits.mean(0) - truth).abs()
    assert bool((error < 5 * fits.std(0) / math.sqrt(150) + 0.01 * truth.abs().max()).all())
    assert float((fits.std(0) / truth.abs().max()).max()) < 0.5  # an estimate that says something


@pytest.mark.parametrize("c", [1.0, -3.0])
def test_few_points_in_many_dimensions_tell_the_mean_curvature(c):
    """c |u|^2 in 200 dimensions from 60 pairs and the centre: curvature 2 c, to a third, where there are points."""
    generator = torch.Generator().manual_seed(0)
    u = normal(generator, 60, 200)
    z = torch.cat([torch.zeros(1, 200, dtype=torch.float64), u, -u])
    model = fit_values(z, c * z.square().sum(1), torch.ones(121, dtype=torch.float64))
    along = model.reduce(u[0]) / u[0].norm()
    assert float(along @ model.hessian @ along) == pytest.approx(2 * c, rel=1 / 3)
    assert float(model.hessian.diagonal().mean()) == pytest.approx(2 * c, rel=1 / 3)
    assert float(model.full_gradient().norm()) < 1e-6 * abs(c)
    assert all(bool(torch.isinf(error).all()) for error in model.full_errors())


def test_fewer_evaluations_than_coefficients_do_not_tell_the_errors_of_a_diagonal():
    """sum_i i u_i^2: the diagonal is 2, 4, ..., and the fit is between the two ends of it."""
    generator = torch.Generator().manual_seed(0)
    sizes = torch.arange(1.0, 11.0, dtype=torch.float64)
    for count, told in ((65, False), (66, True)):  # (n + 1) (n + 2) / 2 = 66
        u = normal(generator, count, 10)
        _, bend = fit_values(u, u.square() @ sizes, torch.ones(count, dtype=torch.float64)).full_errors()
        assert bool(torch.isfinite(bend).all()) == told
        assert bool(torch.isinf(bend).all()) != told


@pytest.mark.parametrize("constant", [0.0, 0.1, -7.0, 1e12, 1e-300])
@pytest.mark.parametrize("count", [1, 2, 10])
def test_constant_values_are_a_plateau(constant, count):
    generator = torch.Generator().manual_seed(0)
    values = torch.full((count,), constant, dtype=torch.float64)
    model = fit_values(normal(generator, count, 3), values, torch.rand(count, dtype=torch.float64) + 0.1)
    assert model.value == constant
    assert model.significance < 0
    assert not model.full_gradient().any()
    assert not model.full_hessian().any()


def test_noise_alone_is_mostly_not_significant():
    """Values without any trend, 20 in 2 dimensions: seen as one in at most 5 % of 200 fits."""
    generator = torch.Generator().manual_seed(0)
    ones = torch.ones(20, dtype=torch.float64)
    seen = [fit_values(normal(generator, 20, 2), normal(generator, 20), ones).significance > 0 for _ in range(200)]
    assert sum(seen) <= 10


@pytest.mark.parametrize(("n", "count"), [(1, 12), (2, 30), (5, 100)])
def test_standard_errors_cover_the_truth(n, count):
    """Quadratics with noise of 0.3, 200 fits: nine in ten of the true elements lie within two standard errors, and
    these are not more than twice as wide as they have to be."""
    generator = torch.Generator().manual_seed(n)
    deviations = []
    for _ in range(200):
        A, b, f = random_quadratic(n, generator)
        u = normal(generator, count, n)
        model = fit_values(u, f(u) + 0.3 * normal(generator, count), torch.ones(count, dtype=torch.float64))
        slope, bend = model.full_errors()
        deviations.append(torch.stack([(model.gradient - b) / slope, (model.hessian - A).diagonal() / bend]))
    deviations = torch.stack(deviations)
    inside = (deviations.abs() < 2).double().mean((0, 2))
    assert bool((inside > 0.88).all())
    assert bool((deviations.square().mean((0, 2)).sqrt() > 0.5).all())


def similarity(target):
    """One less the structural similarity to the target: neither quadratic nor convex."""

    def loss(y):
        a, b = y - y.mean(), target - target.mean()
        luminance = (2 * y.mean() * target.mean() + 0.1) / (y.mean() ** 2 + target.mean() ** 2 + 0.1)
        return 1 - luminance * (2 * (a * b).mean() + 0.1) / ((a * a).mean() + (b * b).mean() + 0.1)

    return loss


LOSSES = {
    "mse": lambda target: lambda y: (y - target).square().mean(),
    "logcosh": lambda target: lambda y: torch.log(torch.cosh(y - target)).sum(),
    "similarity": similarity,
    "norm": lambda target: lambda y: (y - target).norm(),
    "linear": lambda target: lambda y: (y * target).sum(),
}


def linear_output(n, shape):
    """Returns the target, the intercept c [m], the Jacobian J [m, n] and f(u) = c + J u."""
    generator = torch.Generator().manual_seed(0)
    m = math.prod(shape)
    J, c, target = normal(generator, m, n), normal(generator, m), normal(generator, *shape)
    return target, c, J, lambda u: c + u @ J.mT


@pytest.mark.parametrize("name", LOSSES)
@pytest.mark.parametrize(("n", "shape"), [(1, (3,)), (2, (5,)), (5, (2, 2, 3))])
def test_linear_outputs_are_exact(name, n, shape):
    """Value, gradient J^T l' and Gauss-Newton Hessian J^T l'' J, up to a damping of 1e-3 of its mean eigenvalue."""
    target, c, J, f = linear_output(n, shape)
    loss = LOSSES[name](target)
    u = normal(torch.Generator().manual_seed(1), n + 4, n)
    weights = 0.1 + torch.rand(len(u), dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    model = fit_outputs(u, f(u), weights, loss, torch.Size(shape))

    def flat_loss(y):
        return loss(y.view(shape))

    H = J.mT @ torch.func.hessian(flat_loss)(c) @ J
    assert model.value == pytest.approx(float(flat_loss(c)), rel=1e-4, abs=1e-4)
    torch.testing.assert_close(model.full_gradient(), J.mT @ torch.func.grad(flat_loss)(c), rtol=1e-3, atol=1e-4)
    damping = 1e-3 * float(H.diagonal().abs().mean())
    torch.testing.assert_close(model.full_hessian(), H, rtol=1e-4, atol=1.1 * damping + 1e-4)
    s = 0.3 * normal(torch.Generator().manual_seed(3), n)
    assert model.misfit(s, f(s[None])[0]) < 1e-6
    assert model.misfit(s, f(s[None])[0] + J @ s) == pytest.approx(1.0, rel=1e-2)


def test_the_intercept_is_the_smoothed_output():
    """f = u^2 has the mean 1 and, smoothed, no slope; f = sin u + u has the slope 1 + e^(-1/2) (Stein).

    One fit to 600 samples: within 5 standard errors of sums (false alarms: 4 times 6e-7).
    """
    u = normal(torch.Generator().manual_seed(0), 600, 1)
    y = torch.cat([u**2, torch.sin(u) + u], 1)
    model = fit_outputs(u, y, torch.ones(600, dtype=torch.float64), lambda y: y.square().sum(), torch.Size([2]))
    assert model.intercept is not None
    assert model.jacobian is not None
    torch.testing.assert_close(model.intercept, vector(1.0, 0.0), rtol=0, atol=5 * 2 / math.sqrt(600))
    slopes = vector(0.0, 1 + math.exp(-0.5))
    torch.testing.assert_close(model.jacobian[0], slopes, rtol=0, atol=5 * 4 / math.sqrt(600))


def test_fewer_points_than_parameters_know_nothing_outside_of_their_span():
    target, _, _, f = linear_output(20, (4,))
    u = normal(torch.Generator().manual_seed(1), 6, 20)
    u[:, 13:] = 0.0
    for model in (
        fit_outputs(u, f(u), torch.ones(6, dtype=torch.float64), LOSSES["mse"](target), torch.Size([4])),
        fit_values(u, f(u)[:, 0], torch.ones(6, dtype=torch.float64)),
    ):
        assert model.rank == 6
        _, _, rows = torch.linalg.svd(u)
        outside = rows[6:]
        assert float((outside @ model.full_gradient()).abs().max()) < 1e-12
        assert float((outside @ model.full_hessian()).abs().max()) < 1e-12
        assert all(bool(torch.isinf(error).all()) for error in model.full_errors())
        torch.testing.assert_close(model.expand(model.reduce(u[2])), u[2])


def test_standard_errors_of_outputs_cover_the_truth():
    """Linear outputs with noise of 0.2 and a linear loss, 300 fits. The errors are sqrt(25) times the least ones.

    They hold where what is missed does not average out, which noise does.
    """
    _, _, J, f = linear_output(2, (3,))
    generator = torch.Generator().manual_seed(5)
    deviations = []
    for _ in range(300):
        u = normal(generator, 25, 2)
        y = f(u) + 0.2 * normal(generator, 25, 3)
        model = fit_outputs(u, y, torch.ones(25, dtype=torch.float64), lambda y: y.sum(), torch.Size([3]))
        deviations.append((model.full_gradient() - J.sum(0)) / model.full_errors()[0])
    z = torch.stack(deviations)
    assert float((z.abs() < 2).double().mean()) > 0.95
    assert 0.8 < 5.0 * float(z.square().mean().sqrt()) < 1.2


def test_as_many_points_as_coefficients_do_not_tell_the_errors_of_outputs():
    """A sum of magnitudes has no curvature: its error is still infinite, and no NaN."""
    _, _, _, f = linear_output(3, (5,))
    u = normal(torch.Generator().manual_seed(0), 4, 3)
    model = fit_outputs(u, f(u), torch.ones(4, dtype=torch.float64), lambda y: y.abs().sum(), torch.Size([5]))
    assert all(bool((error == math.inf).all()) for error in model.full_errors())


def test_standard_errors_of_outputs_cover_what_is_curved():
    """Outputs exp(0.3 A u), all curved alike, and squares: J^T J at 0 from 14 points is off by up to 40 %."""
    generator = torch.Generator().manual_seed(0)
    inside = []
    for _ in range(100):
        slope = 0.3 * (1.0 + 0.1 * normal(generator, 30, 2))
        target = torch.ones(30, dtype=torch.float64) + 0.1 * normal(generator, 30)
        u = normal(generator, 14, 2)
        loss = sum_of_squares(target)
        model = fit_outputs(u, torch.exp(u @ slope.mT), torch.ones(14).double(), loss, torch.Size([30]))
        true = 2.0 * slope.square().sum(0)
        inside.append((model.full_hessian().diagonal() - true).abs() < 2.0 * model.full_errors()[1])
    assert float(torch.stack(inside).double().mean()) > 0.9


def test_the_curvature_of_outputs_is_damped_only_for_steps():
    """The smallest eigenvalue of J^T J is 1e-6 of the largest: damping of 1e-3 would hide it."""
    scale = vector(1.0, 1e-3)
    u = normal(torch.Generator().manual_seed(0), 12, 2)

    def fitted(damping):
        weights = torch.ones(12, dtype=torch.float64)
        return fit_outputs(u, u * scale, weights, lambda y: y.square().sum(), torch.Size([2]), damping).full_hessian()

    torch.testing.assert_close(fitted(0.0), torch.diag(2.0 * scale.square()), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(fitted(0.1) - fitted(0.0), 0.1 * torch.eye(2).double(), rtol=1e-3, atol=1e-9)


def test_a_loss_without_derivatives_where_it_is_needed_says_nothing():
    """The norm of the difference to an output that is the target: its derivative is not defined."""
    u = normal(torch.Generator().manual_seed(0), 6, 2)
    target = vector(1.0, 2.0, 3.0)
    loss = LOSSES["norm"](target)
    model = fit_outputs(u, target.expand(6, 3).clone(), torch.ones(6, dtype=torch.float64), loss, torch.Size([3]))
    assert bool(torch.isfinite(model.full_gradient()).all())
    assert bool(torch.isfinite(model.full_hessian()).all())
    root = fit_outputs(u, u @ torch.ones(2, 3).double() * 0, torch.ones(6).double(), torch.sum, torch.Size([3]))
    assert float(root.full_gradient().abs().max()) == 0.0


@pytest.mark.parametrize(
    "loss",
    [
        lambda y: y.square().mean(),
        lambda y: (torch.arange(1.0, 7.0, dtype=torch.float64).view(2, 3) * y.square()).sum(),
        lambda y: (y[0] * y[1]).sum() + y.exp().sum(),
        lambda y: 3.0 * y.sum(),
    ],
    ids=["mean square", "weighted", "coupled", "linear"],
)
@pytest.mark.parametrize("count", [1, 5])
def test_second_derivatives_of_a_loss_are_those_of_torch_func(loss, count):
    generator = torch.Generator().manual_seed(0)
    output = torch.randn(2, 3, generator=generator, dtype=torch.float64)
    directions = torch.randn(count, 2, 3, generator=generator, dtype=torch.float64)
    found = loss_curvature(loss, output)
    value, slope, products = found.value, found.slope.flatten(), found.products(directions)
    hessian = torch.func.hessian(loss)(output).reshape(6, 6)
    assert value == pytest.approx(float(loss(output)))
    assert torch.allclose(slope, torch.func.grad(loss)(output).flatten())
    assert torch.allclose(products, directions.flatten(1) @ hessian)


def test_a_second_derivative_that_is_a_multiple_of_the_identity_is_seen():
    """Products then take no call of autograd. Its own rounding does not hide it."""
    y = normal(torch.Generator().manual_seed(0), 60)
    assert loss_curvature(lambda z: 3 * (z - 0.3).square().mean() / 7, y).second == pytest.approx(2 * 3 / 7 / 60)
    bent = loss_curvature(lambda z: (z - 0.3).square().mean() + 1e-9 * z[0] ** 2, y)
    assert not isinstance(bent.second, float)


def test_slopes_that_are_not_finite_count_as_zero():
    loss, output = lambda z: z.sqrt().sum() + z.square().sum(), torch.tensor([[0.0, 4.0]], dtype=torch.float64)
    expected = torch.tensor([[0.0, 8.25]], dtype=torch.float64)
    value, slope = value_and_slope(loss, output)
    assert value == 18.0
    assert torch.equal(slope, expected)
    assert torch.equal(loss_curvature(loss, output).slope, expected)
