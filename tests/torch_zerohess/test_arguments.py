"""Checks of single arguments: what is in a range, and what the message says of the others."""

import math

import pytest

from torch_zerohess.arguments import checked_number

RANGES = [
    ({}, [0.0, -1e300, math.inf], [math.nan], "x must be a number"),
    ({"least": 0.0}, [0.0, math.inf], [-1e-300, math.nan], "x must be at least 0"),
    ({"above": 0.0}, [1e-300, math.inf], [0.0, -1.0, math.nan], "x must be positive"),
    ({"above": 0.0, "below": math.inf}, [1e-300, 1e300], [0.0, math.inf, math.nan], "x must be positive and finite"),
    ({"above": 2.0, "below": 3.0}, [2.5], [2.0, 3.0], "x must be above 2 and below 3"),
    ({"least": 0.0, "most": 1.0}, [0.0, 1.0], [-0.1, 1.1], "x must be at least 0 and at most 1"),
    ({"above": 0.0, "most": math.inf, "below": math.inf}, [1.0], [math.inf], "x must be positive and finite"),
]


@pytest.mark.parametrize(("ends", "inside", "outside", "message"), RANGES)
def test_a_number_in_its_range(ends, inside, outside, message):
    for value in inside:
        assert checked_number("x", value, **ends) == value
    for value in outside:
        with pytest.raises(ValueError, match=f"{message}, got {value}"):
            checked_number("x", value, **ends)


@pytest.mark.parametrize("value", ["1", b"1", True, None, [1.0], 1j])
def test_what_is_no_number(value):
    with pytest.raises(TypeError, match="x must be a number, got"):
        checked_number("x", value, above=0.0)
