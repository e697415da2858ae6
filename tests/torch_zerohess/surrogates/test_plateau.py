"""Which values around a point are a plateau: by hand. The steps to the points have a root mean square of their size."""

import pytest
import torch

from torch_zerohess.surrogates.plateau import is_plateau
from truths import vector


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        ((7.0, 7.0, 7.0, 7.0), True),
        ((1.0, 2.0, 3.0, 7.0), True),  # one in four
        ((7.0, 2.0, 3.0, 4.0), True),  # the nearest one
        ((1.0, 2.0, 3.0, 4.0), False),
    ],
)
def test_a_quarter_of_the_values_around_a_point_are_a_plateau(values, expected):
    steps = vector(4.0, 1.0, 2.0, 3.0)[:, None]
    assert is_plateau(steps, vector(values[3], *values[:3]), 7.0, beyond=0.5) is expected


def test_one_value_in_five_lies_on_the_floor_of_a_valley():
    values = vector(1.0, 2.0, 3.0, 4.0, 7.0)
    steps = vector(1.0, 2.0, 3.0, 4.0, 5.0)[:, None]
    assert not is_plateau(steps, values, 7.0, beyond=0.5)
    assert is_plateau(steps, values, 7.0, beyond=1.0)


def test_values_that_are_too_near_or_none_are_no_plateau():
    assert not is_plateau(vector(0.5, 0.1, 3.0)[:, None], vector(7.0, 7.0, 1.0), 7.0, beyond=0.5)
    assert not is_plateau(vector()[:, None], vector(), 7.0, beyond=0.5)


@pytest.mark.parametrize(
    ("aside", "beside", "expected"),
    [
        (0.0, 7.1, False),  # a floor along the first parameter
        (1.0, 7.1, True),  # equal values on both sides of that line, too
        (0.1, 7.1, False),  # but for rounding
        (0.0, 7.0, True),  # no other value next to the point
        (0.0, 6.9, True),  # a lower one, which is no floor
        (0.0, torch.inf, True),
    ],
)
def test_equal_values_along_a_line_are_a_floor(aside, beside, expected):
    """The equal values lie at (-2, 0), (1, 0) and (4, aside), and another one next to the point."""
    steps = torch.tensor([[-2.0, 0.0], [1.0, 0.0], [4.0, aside], [0.0, 3.0], [0.0, 0.1]], dtype=torch.float64)
    values = vector(7.0, 7.0, 7.0, 8.0, beside)
    assert is_plateau(steps, values, 7.0, beyond=0.2) is expected


def test_the_extent_of_a_plateau_is_a_root_mean_square():
    """Equal values at a distance of 1 along each of 16 parameters, and another one next to the point."""
    steps, values = torch.eye(16).double(), torch.full((17,), 7.0).double()
    values[-1] = 7.1
    assert is_plateau(torch.cat([steps, 0.01 * steps[:1]]), values, 7.0, beyond=0.2)
    assert not is_plateau(torch.cat([steps, 0.01 * steps[:1]])[1:], values[1:], 7.0, beyond=0.2)


def test_equal_values_beyond_the_plateau_say_nothing_of_its_extent():
    """Half of the values are equal out to a distance of 2 along one parameter, and one of many far away."""
    far = 9.0 + torch.linspace(0, 1, 80).view(40, 2)
    steps = torch.cat([torch.tensor([[0.1, 0.1], [1.0, 0.0], [2.0, 0.0]]), far]).double()
    values = torch.cat([vector(7.1, 7.0, 7.0), 8.0 + torch.zeros(40).double()])
    values[20] = 7.0
    assert not is_plateau(steps, values, 7.0, beyond=0.2)
