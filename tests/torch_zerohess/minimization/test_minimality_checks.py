"""Which evaluations around a point are a jump or a plateau: by hand."""

import math

import pytest
import torch

from torch_zerohess.minimization.minimality_checks import doubt, has_cusp, is_constant, jumps
from truths import vector


@pytest.mark.parametrize(
    ("distance", "value", "expected"),
    [
        (1e-6, 0.01, True),
        (1e-6, 1e-4, False),
        (1e-2, 0.5, True),
        (1e-2, 0.05, False),  # a kink
        (0.1, 0.9, False),
        (1e-6, math.nan, True),
        (0.05, math.nan, True),  # a failure counts farther away
        (0.05, 0.5, False),
        (0.1, math.nan, False),
    ],
)
def test_a_jump_is_large_for_its_distance(distance: float, value: float, expected: bool) -> None:
    """All values are from 0, at x, to 1."""
    x, unit = vector(3.0), vector(2.0)
    points = x + unit * torch.tensor([[0.0], [distance], [5.0]]).double()
    assert jumps(points, vector(0.0, value, 1.0), x, 0.0, unit) is expected


@pytest.mark.parametrize(("failed", "expected"), [(0.06, True), (0.08, False)])
def test_failures_are_next_to_x_by_their_distance_per_parameter(failed: float, expected: bool) -> None:
    """In 100 parameters; at 0.06 sigma along each of them the distance is 0.6 sigma."""
    x = torch.zeros(100).double()
    points = torch.stack([x, x + failed, x + 5.0])
    assert jumps(points, vector(0.0, math.nan, 1.0), x, 0.0, torch.ones_like(x)) is expected


@pytest.mark.parametrize(
    ("beyond", "expected"),
    [
        (lambda d: 1e-4 + 0.01 * d, True),
        (lambda d: 1e-7 + 0.0 * d, False),  # less than what tells
        (lambda d: 1e-4 * (0.55 + 4e3 * d), False),  # roughness has rises of every size
        (lambda d: d, False),  # a kink
    ],
)
def test_a_small_jump_between_smooth_pieces_is_an_edge(beyond, expected):
    """The loss rises by 1e-5 of the distance on this side of the edge, by more beyond it, and nowhere above 1."""
    x, d = vector(3.0), torch.logspace(-7, -4, 7, dtype=torch.float64)
    points = torch.cat([x[None], x + d[:, None], x - d[:, None], x[None] + 5.0])
    losses = torch.cat([vector(0.0), 1e-5 * d, beyond(d), vector(1.0)])
    assert jumps(points, losses, x, 0.0, vector(1.0)) is expected
    few = torch.tensor([0, 1, 2, *range(8, 16)])  # too few on this side
    assert not jumps(points[few], losses[few], x, 0.0, vector(1.0))
    assert not jumps(points, torch.where(losses < 5e-5, 0.0, losses), x, 0.0, vector(1.0))  # rounded values
    near = ((points - x).norm(dim=1) < 1.0)[:, None]  # all at one distance
    assert not jumps(torch.where(near, x + 1e-5 * (points - x).sign(), points), losses, x, 0.0, vector(1.0))


def test_without_a_finite_value_nothing_is_known() -> None:
    assert not jumps(torch.zeros(2, 1).double(), vector(math.nan, math.nan), vector(0.0), math.nan, vector(1.0))


@pytest.mark.parametrize(("distance", "constant"), [(1e-4, False), (0.01, True), (0.2, True), (0.5, False)])
def test_an_equal_value_near_x_is_a_plateau(distance, constant):
    """Nearer it may be rounding, farther away another minimum. Distances are in units of sigma, here of 3."""
    points = vector(0.0, 0.0) + torch.stack([vector(0.0, 0.0), 3.0 * distance * vector(1.0, -1.0), vector(9.0, 9.0)])
    values, unit = vector(0.5, 0.5, 7.0), vector(3.0, 3.0)
    assert is_constant(points, values, points[0], 0.5, unit) == constant
    assert is_constant(points, values + vector(0.0, 1e-9, 0.0), points[0], 0.5, unit) is False
    assert ("constant" in doubt(points, values, points[0], 0.5, unit)) == constant


@pytest.mark.parametrize(
    ("fn", "expected"),
    [
        (lambda d: d.sqrt(), True),
        (lambda d: d, False),
        (lambda d: d.square(), False),
        (lambda d: d.square() + 1e-4 * (d > 0.0), False),  # roughness
    ],
)
def test_a_cusp_is_steeper_the_nearer(fn, expected):
    """Distances are in units of sigma, here of 3, and from a kink, a quadratic or a square root of them."""
    distance = vector(0.0, 1e-5, 1e-4, 9e-4, 1e-2, 0.11, 0.5)
    points, unit = 7.0 + 3.0 * distance[:, None], vector(3.0)
    assert has_cusp(points, fn(distance), points[0], unit) is expected
    assert has_cusp(points[1:], fn(distance[1:]), points[0], unit) is False


def test_in_a_box_narrower_than_sigma_distances_are_relative_to_the_box():
    """A smooth parabola in [0, 0.01], and the same with a jump beside its minimum; sigma is 1."""
    points = torch.linspace(0.0, 0.01, 21, dtype=torch.float64)[:, None]
    losses, x = ((points[:, 0] - 0.004) / 0.01).square(), vector(0.004)
    assert doubt(points, losses, x, 0.0, vector(1.0)) == ""
    points, losses = torch.cat([points, x[None] + 1e-4]), torch.cat([losses, vector(0.3)])
    assert "jumps" in doubt(points, losses, x, 0.0, vector(1.0))
