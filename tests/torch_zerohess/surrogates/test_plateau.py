"""Which values around a point are a plateau: by hand."""

import pytest

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
    assert is_plateau(vector(4.0, 1.0, 2.0, 3.0), vector(values[3], *values[:3]), 7.0, beyond=0.5) is expected


def test_one_value_in_five_lies_on_the_floor_of_a_valley():
    values = vector(1.0, 2.0, 3.0, 4.0, 7.0)
    assert not is_plateau(vector(1.0, 2.0, 3.0, 4.0, 5.0), values, 7.0, beyond=0.5)
    assert is_plateau(vector(1.0, 2.0, 3.0, 4.0, 5.0), values, 7.0, beyond=1.0)


def test_values_that_are_too_near_or_none_are_no_plateau():
    assert not is_plateau(vector(0.5, 0.1, 3.0), vector(7.0, 7.0, 1.0), 7.0, beyond=0.5)
    assert not is_plateau(vector(), vector(), 7.0, beyond=0.5)
