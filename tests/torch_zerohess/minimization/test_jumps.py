"""Which evaluations around a point are a jump: by hand, in one parameter with sigma = 2."""

import math

import pytest
import torch

from torch_zerohess.minimization.jumps import jumps
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
        (1e-2, math.nan, True),
        (0.1, math.nan, False),
    ],
)
def test_a_jump_is_large_for_its_distance(distance: float, value: float, expected: bool) -> None:
    """All values are from 0, at x, to 1."""
    x, unit = vector(3.0), vector(2.0)
    points = x + unit * torch.tensor([[0.0], [distance], [5.0]]).double()
    assert jumps(points, vector(0.0, value, 1.0), x, 0.0, unit) is expected


def test_without_a_finite_value_nothing_is_known() -> None:
    assert not jumps(torch.zeros(2, 1).double(), vector(math.nan, math.nan), vector(0.0), math.nan, vector(1.0))
