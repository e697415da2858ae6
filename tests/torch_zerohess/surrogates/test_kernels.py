"""Kernels, joint and additive: their formulas, their derivatives, and which functions they suit."""

import math

import pytest
import torch

from torch_zerohess.surrogates.gaussian_process import GaussianProcess
from torch_zerohess.surrogates.kernels import KERNELS, distances, gaussian, matern, structures
from truths import normal, vector


def test_kernels_are_their_textbook_formulas():
    d = torch.tensor([0.0, 0.5, 2.0], dtype=torch.float64)
    expected = [(1 + math.sqrt(3) * x) * math.exp(-math.sqrt(3) * x) for x in d.tolist()]
    assert torch.allclose(matern(d), vector(*expected), rtol=1e-14)
    assert torch.allclose(gaussian(d), vector(*[math.exp(-(x**2) / 2) for x in d.tolist()]), rtol=1e-14)


@pytest.mark.parametrize("kernel", KERNELS)
def test_derivatives_are_those_of_the_formula(kernel):
    """The kernels' derivatives written out: d/dd matern = -3 d exp(-sqrt(3) d), d/dd gaussian = -d exp(-d^2/2)."""
    points, weights = 2 * normal(8, 3), normal(8, 5, seed=1)
    x = torch.cat([normal(4, 3, seed=5), points[:2]])

    def predicted(one):
        return (kernel(distances(one[None] / 1.3, points / 1.3)) @ weights)[0]

    step = (x[:, None] - points) / 1.3
    d = step.norm(dim=2)
    decay = (math.sqrt(3.0) * d).neg().exp() if kernel is matern else (-0.5 * d.square()).exp()
    factor = 3.0 if kernel is matern else 1.0
    slope = torch.einsum("qp,qpi,pm->qmi", -factor * decay, step / 1.3, weights)
    torch.testing.assert_close(torch.func.vmap(torch.func.jacrev(predicted))(x), slope, atol=1e-6, rtol=1e-6)
    torch.testing.assert_close(torch.func.vmap(torch.func.jacfwd(predicted))(x), slope, atol=1e-6, rtol=1e-6)
    # d2/dx2 = factor/l^2 decay (c v v' - I) with v the step and c = sqrt(3)/d for the Matern kernel, 1 for the other.
    ratio = math.sqrt(3.0) / d.clamp_min(1e-12) if kernel is matern else torch.ones_like(d)
    bend = ratio[..., None, None] * step[..., :, None] * step[..., None, :] - torch.eye(3).double()
    second = torch.einsum("qp,qpij,pm->qmij", factor * decay / 1.3**2, bend, weights)
    torch.testing.assert_close(torch.func.vmap(torch.func.hessian(predicted))(x), second, atol=1e-6, rtol=1e-6)


def test_distances_far_from_the_origin_are_exact():
    points, x = normal(10, 2), normal(5, 2, seed=1)
    torch.testing.assert_close(distances(x + 1e7, points + 1e7), distances(x, points), atol=1e-7, rtol=0)


def sums(z):
    """Functions of one of six parameters each, and a sum of such functions."""
    return torch.cat([(3.0 * z).sin(), (3.0 * z).cos().sum(1, keepdim=True)], 1)


def pairs(z):
    """Functions of two of six parameters each."""
    return (z - 1.5).sin() * (z.roll(1, 1) - 1.5).cos()


@pytest.mark.parametrize(("f", "structure", "count", "ratio"), [(sums, "single", 30, 0.3), (pairs, "pairs", 60, 0.75)])
def test_sums_of_functions_of_few_parameters_are_known_from_few_points(f, structure, count, ratio):
    """The error is this part of the error of a joint kernel, at most."""
    generator = torch.Generator().manual_seed(0)
    points, x = (3 * torch.rand(k, 6, generator=generator, dtype=torch.float64) for k in (count, 100))
    found = GaussianProcess.fit(points, f(points), structures=structures(6))
    joint = GaussianProcess.fit(points, f(points))
    assert found.structure == structure
    errors = [float((one.predict(x) - f(x)).square().mean()) for one in (found, joint)]
    assert errors[0] < ratio * errors[1]


def test_a_function_of_the_distance_keeps_the_joint_kernel():
    points = normal(40, 4)
    found = GaussianProcess.fit(points, torch.exp(-points.square().sum(1, keepdim=True)), structures=structures(4))
    assert found.structure == "joint"


def test_structures_are_chosen_from_four_parameters_on():
    assert structures(3) == ("joint",)
    assert structures(4) == ("joint", "single", "pairs")
