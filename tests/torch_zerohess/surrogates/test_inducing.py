"""The process of chosen points against the exact one."""

import pytest
import torch

from torch_zerohess.surrogates.gaussian_process import CONSTANT
from torch_zerohess.surrogates.inducing import InducedProcess
from torch_zerohess.surrogates.kernels import gaussian, matern


def data(P: int = 25):
    z = torch.randn(P, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return z, torch.stack([z[:, 0].sin(), z.prod(1), z.sum(1)], 1)


def test_with_all_points_chosen_it_is_the_exact_posterior() -> None:
    points, outputs = data()
    found = InducedProcess.condition(points, outputs, matern, 1e-3)
    assert len(found.points) == len(points)
    x = data(40)[0][25:] * 1.5
    inverse = torch.linalg.inv(matern(torch.cdist(points, points)) + CONSTANT + 1e-3 * torch.eye(25).double())
    cross, change = matern(torch.cdist(x, points)) + CONSTANT, outputs - outputs.mean(0)
    torch.testing.assert_close(found(x), outputs.mean(0) + cross @ inverse @ change, atol=1e-7, rtol=1e-7)
    variance = (change * (inverse @ change)).mean() * (1.0 + CONSTANT - (cross @ inverse * cross).sum(1))
    torch.testing.assert_close(found.uncertainty(x), variance, atol=1e-6, rtol=1e-5)


def test_it_is_certain_at_the_data_and_not_far_away() -> None:
    points, outputs = data()
    found = InducedProcess.condition(points, outputs, matern, 1e-6)
    assert float(found.uncertainty(points).max()) < 1e-4 * found.variance
    assert float(found.uncertainty(points[:1] + 100.0)) > 0.9 * found.variance


def test_where_nothing_is_explained_derivatives_are_finite() -> None:
    points, outputs = data()
    found = InducedProcess.condition(points, outputs, gaussian, 1e3)
    x = points[:3].clone().requires_grad_()
    (slope,) = torch.autograd.grad(found(x).sum(), x)
    torch.testing.assert_close(slope, torch.zeros_like(slope), atol=0.02, rtol=0)


def test_duplicates_are_not_chosen_twice() -> None:
    points, outputs = data()
    once = InducedProcess.condition(points, outputs, gaussian, 1e-3)
    twice = InducedProcess.condition(points.repeat(3, 1), outputs.repeat(3, 1), gaussian, 1e-3)
    assert len(twice.points) <= len(once.points) + 3
    assert len(twice.points) <= len(points)
    torch.testing.assert_close(twice(points), outputs, atol=0.05, rtol=0)


def test_where_all_is_noise_no_point_is_chosen_and_the_mean_is_predicted() -> None:
    points, outputs = data()
    found = InducedProcess.condition(points, outputs, matern, 1e6)
    assert len(found.points) == 0
    torch.testing.assert_close(found(points[:3]), outputs.mean(0).expand(3, 3))
    spread = (outputs - outputs.mean(0)).square().mean() / 1e6  # variance of the process, a millionth of the noise
    torch.testing.assert_close(found.uncertainty(points[:3]), 2.0 * spread.expand(3), rtol=1e-6, atol=0)


@pytest.mark.parametrize(("noise", "left"), [(1.0, 0.1), (1e-2, 1e-3), (1e-6, 1e-7), (1e-8, 1e-7)])
def test_as_few_points_are_chosen_as_explain_all_but_a_tenth_of_the_noise(noise, left) -> None:
    """All but 1e-7 of the variance of the process at least. With one point fewer, more is left somewhere."""
    points, outputs = data(300)
    chosen = InducedProcess.condition(points, outputs, gaussian, noise).points
    assert 1 < len(chosen) < 300

    def rest(some):
        """Variance of the process at all points, given some of them."""
        between, own = (gaussian(torch.cdist(some, one)) + 1.0 for one in (points, some))
        return float((2.0 - (between * torch.linalg.solve(own, between)).sum(0)).max())

    assert rest(chosen) <= left < rest(chosen[:-1])


def test_at_most_512_points_are_chosen() -> None:
    points = torch.randn(520, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert len(InducedProcess.condition(points, points, matern, 1e-6).points) == 512
