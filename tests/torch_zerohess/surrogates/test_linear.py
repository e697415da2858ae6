"""The linear surrogate against the map that it is fitted to."""

import math

import pytest
import torch

from torch_zerohess.surrogates.linear import LinearSurrogate, left_out_share
from truths import normal, vector

SLOPE, OFFSET = normal(6, 10, seed=1), normal(10, seed=2)


def images(x):
    return (x @ SLOPE + OFFSET).unflatten(-1, (2, 5))


@pytest.mark.parametrize("P", [7, 8, 50])
def test_an_affine_map_is_exact(P):
    points, z = normal(P, 6) + 3.0, normal(5, 6, seed=3)
    model = LinearSurrogate()
    model.fit(points, images(points))
    torch.testing.assert_close(model(z), images(z), atol=1e-6, rtol=0)
    jacobian = torch.func.jacrev(lambda x: model(x[None])[0].flatten())(z[0])
    torch.testing.assert_close(jacobian, SLOPE.mT, atol=1e-6, rtol=0)


def test_with_fewer_points_than_parameters_the_slope_has_the_least_norm():
    points, z = normal(4, 6), normal(5, 6, seed=3)
    outputs = images(points).flatten(1)
    model = LinearSurrogate()
    model.fit(points, outputs)
    middle, mean = points.mean(0), outputs.mean(0)
    expected = mean + (z - middle) @ torch.linalg.pinv(points - middle) @ (outputs - mean)
    torch.testing.assert_close(model(z), expected, atol=1e-6, rtol=0)


@pytest.mark.parametrize("P", [4, 50])
def test_parameters_may_be_of_any_units(P):
    """Degrees, metres, and a constant: least squares and the least norm are those of equal units."""
    points, z = normal(P, 6), normal(5, 6, seed=3)
    equal, mixed = LinearSurrogate(), LinearSurrogate()
    equal.fit(points, images(points))
    for size in (64.0**-3, 1.0, 64.0**5):
        units = size * 64.0 ** vector(0, 0, 0, 0, -5, 3)
        mixed.fit(points * units, images(points))
        torch.testing.assert_close(mixed(z * units), equal(z), atol=1e-9, rtol=0)
        torch.testing.assert_close(mixed.variance(units), equal.variance(torch.ones(6)))


@pytest.mark.parametrize(("place", "spread"), [(0.1, 1.0), (1e14 / 3, 1e-6)])
def test_a_parameter_that_stays_has_no_slope(place, spread):
    """The mean of seven equal numbers 0.1 is another number, whose difference must not count as a spread."""
    points, z = normal(7, 6), normal(5, 6, seed=3)
    points[:, 0] = z[:, 0] = 0.0
    assert float(torch.full((7,), place, dtype=torch.float64).mean()) != place
    model = LinearSurrogate()
    model.fit(spread * points + place * vector(1, 0, 0, 0, 0, 0), images(points))
    new = model(spread * z + 3.0 * place * vector(1, 0, 0, 0, 0, 0))
    torch.testing.assert_close(new, images(z), atol=1e-6, rtol=0)


@pytest.mark.parametrize(("unit", "size"), [(1.0, 1.0), (1e-20, 1e-20), (1.0, 1e30)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_products_are_in_the_precision_of_the_outputs_where_that_is_enough(dtype, unit, size):
    """Float32 has few digits, and few exponents: points or slopes that are far from 1 stay in float64."""
    points, z = normal(50, 6) + 3.0, normal(5, 6, seed=3)
    model = LinearSurrogate()
    model.fit(unit * points, size * images(points).to(dtype))
    single = dtype == torch.float32 and unit == size == 1.0
    assert model._slope.dtype == (torch.float32 if single else torch.float64)
    error = 1e-5 if dtype == torch.float32 else 1e-7
    torch.testing.assert_close(model(unit * z) / size, images(z), atol=error, rtol=0)
    assert model((unit * z).float()).dtype == torch.float32


def test_each_point_is_left_out_once():
    """Against fits to all others, in any unit; and a point that determines a slope alone."""
    points, outputs = normal(12, 6), normal(12, 10, seed=4) + images(normal(12, 6)).flatten(1)
    rest = 0.0
    for k in range(12):
        model, others = LinearSurrogate(), torch.arange(12) != k
        model.fit(points[others], outputs[others])
        rest += float((model(points[k : k + 1]) - outputs[k]).square().sum())
    expected = 1.0 - rest / float((outputs - outputs.mean(0)).square().sum())
    assert left_out_share(points, outputs) == pytest.approx(expected, rel=1e-6)
    assert left_out_share(points, 1e-30 * outputs.float()) == pytest.approx(expected, rel=1e-4)
    points[1:, 0] = 0.0
    assert left_out_share(points, outputs) == -math.inf


def test_noise_is_averaged_by_least_squares():
    points = normal(40, 6)
    outputs = images(points).flatten(1) + 0.1 * normal(40, 10, seed=4)
    model = LinearSurrogate()
    model.fit(points, outputs)
    design = torch.cat([torch.ones(40, 1).double(), points], 1)
    expected = design @ torch.linalg.lstsq(design, outputs).solution
    torch.testing.assert_close(model(points), expected, atol=1e-6, rtol=0)


def test_types_capacity_and_outputs_that_do_not_change():
    points = normal(12, 6).float()
    model = LinearSurrogate(capacity=8)
    outputs = images(points.double()).float()
    outputs[:4] = 1e3
    model.fit(points, outputs)
    assert model(points).dtype == torch.float32
    torch.testing.assert_close(model(points[4:]), outputs[4:], atol=1e-4, rtol=0)
    model.fit(points[:1].expand(3, 6), torch.ones(3, 2))
    torch.testing.assert_close(model(points), torch.ones(12, 2))
    with pytest.raises(ValueError, match="capacity must be at least 2, got 1"):
        LinearSurrogate(capacity=1)
