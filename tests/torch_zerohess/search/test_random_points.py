"""Points of a search that would lie outside of its box."""

import torch

from torch_zerohess.search.random_points import reflect
from truths import vector


def test_points_outside_of_a_box_are_mirrored_into_it_or_moved_to_its_sides() -> None:
    z = torch.stack([vector(-0.2, 0.4), vector(1.3, 0.4), vector(2.5, 0.4), vector(0.5, -9.0)])
    found = reflect(z, vector(0.0, 0.0), vector(1.0, 0.5))
    expected = torch.stack([vector(0.2, 0.4), vector(0.7, 0.4), vector(0.0, 0.4), vector(0.5, 0.0)])
    torch.testing.assert_close(found, expected)
