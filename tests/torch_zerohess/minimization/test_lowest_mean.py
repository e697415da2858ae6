"""Which of two points has the lower mean, where noise is less, or more, than where it was measured."""

import math

import pytest
import torch

from torch_zerohess.minimization.noise import lowest_mean

TWO = torch.tensor([[0.7], [0.0]], dtype=torch.float64)


def choices(loss, deviation, noise, evaluations, seeds):
    """Return the decisions between TWO, of which a model has chosen the first."""
    found = []
    for seed in range(seeds):
        generator = torch.Generator().manual_seed(seed)

        def f(z, generator=generator):
            return loss(z[:, 0]) + deviation(z[:, 0]) * torch.randn(len(z), generator=generator, dtype=torch.float64)

        found.append(lowest_mean(f, TWO, evaluations, noise, trusted=True))
    return found


def share(found):
    return sum(k for k, _, _ in found) / len(found)


@pytest.mark.parametrize("evaluations", [16, 40])
def test_where_noise_is_less_its_own_spread_shows_which_is_lower(evaluations):
    """The deviation is 0.1 |z|, plus 0.02, and was measured at |z| = 5: three errors of that are 1, or 0.7."""
    found = choices(torch.square, lambda z: 0.02 + 0.1 * z.abs(), 0.52, evaluations, 40)
    assert share(found) > 0.9
    for _, value, error in (one for one in found if one[0] == 1):
        assert abs(value) < 4 * error
        assert error <= 0.52 / math.sqrt(evaluations // 4)


def test_a_point_in_doubt_is_compared_again_with_evaluations_of_its_own():
    """Means 0.35 apart: three errors are 0.4 when the points are first compared, and two are 0.19 at the end."""
    found = choices(lambda z: 0.5 * z, lambda z: 0.3, 0.3, 40, 100)
    assert share(found) > 0.65
    values = torch.tensor([value for k, value, _ in found if k == 1])
    assert abs(float(values.mean())) < 0.05


@pytest.mark.parametrize(("noise", "most"), [(3.0, 0.05), (0.3, 0.05), (0.03, 0.1)])
def test_points_that_are_equal_are_seldom_exchanged(noise, most):
    """Noise of 0.3 is declared as 3, 0.3, or 0.03. Student's t with two degrees of freedom is beyond 3 in 5 %."""
    assert share(choices(lambda z: 0 * z, lambda z: 0.3, noise, 8, 400)) < most


def test_values_that_are_equal_by_chance_decide_nothing():
    """Three errors of the noise are 1; the means are 0.35 apart."""
    assert share(choices(lambda z: 0.5 * z, lambda z: 0.0, 0.5, 16, 1)) == 0.0
    assert share(choices(lambda z: 3.0 * z, lambda z: 0.0, 0.5, 16, 1)) == 1.0
