"""Newton with the whole Hessian: the step against the exact solution in a ball, and functions with known minima."""

import math

import pytest
import torch
from subproblems import random_problem, rosenbrock

import torch_zerohess as zh
from torch_zerohess.linalg.subproblem import diagonal_step
from truths import Quadratic, vector


def best_on_a_grid(w, a, radius):
    """Smallest a.y + y.(w y)/2 over the disc, by brute force in polar coordinates."""
    angle = torch.linspace(0, 2 * math.pi, 2001, dtype=torch.float64)
    r = torch.linspace(0, radius, 1001, dtype=torch.float64)[:, None]
    y0, y1 = r * angle.cos(), r * angle.sin()
    return float((a[0] * y0 + a[1] * y1 + 0.5 * (w[0] * y0**2 + w[1] * y1**2)).min())


@pytest.mark.parametrize("radius", [0.1, 1.0, 20.0])
@pytest.mark.parametrize(
    ("w", "a"),
    [
        ((1.0, 5.0), (1.0, -2.0)),
        ((-1.0, 5.0), (1.0, -2.0)),
        ((-3.0, -1.0), (0.5, 0.5)),
        ((-2.0, 1.0), (0.0, 1.0)),  # the hard case: no gradient along the lowest eigenvector
        ((-2.0, 1.0), (0.0, 0.0)),
        ((0.0, 1.0), (0.0, 1.0)),
        ((0.0, 1.0), (1.0, 1.0)),
        ((1e-30, 1e30), (1.0, 1e30)),
    ],
)
def test_step_is_the_minimum_of_the_model_in_the_ball(w, a, radius):
    w, a = vector(*w), vector(*a)
    y = diagonal_step(a, w, radius)
    assert float(y.norm()) <= radius * (1 + 1e-9)
    reached = float(a @ y + 0.5 * (w * y) @ y)
    best = best_on_a_grid(w, a, radius)
    assert reached <= best + 1e-9 * abs(best)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("modification", ["shift", "abs"])
def test_a_convex_quadratic_takes_one_step(dtype, modification):
    H, b = random_problem(3, [1.0, 2.0, 5.0, 9.0])
    x = torch.ones(4, dtype=dtype, requires_grad=True)
    optimizer = zh.optim.Newton([x], radius=100.0, modification=modification)
    optimizer.step(lambda: 0.5 * x @ H.to(dtype) @ x + b.to(dtype) @ x)
    tolerance = 1e-12 if dtype == torch.float64 else 1e-4
    torch.testing.assert_close(x.detach().double(), -torch.linalg.solve(H, b), rtol=0, atol=tolerance)
    assert optimizer.exit == "converged"


def test_abs_goes_as_far_from_a_saddle_as_it_would_go_to_it():
    x = vector(1.0, 3.0).requires_grad_()
    zh.optim.Newton([x], radius=100.0, modification="abs").step(lambda: x[0] ** 2 - 2 * x[1] ** 2)
    torch.testing.assert_close(x.detach(), vector(0.0, 6.0))


def test_shift_leaves_a_saddle_without_gradient():
    x = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.Newton([x], radius=0.5)
    for _ in range(30):
        optimizer.step(lambda: x[0] ** 2 - x[1] ** 2 + 0.5 * x[1] ** 4)
    torch.testing.assert_close(x.detach().abs(), vector(0.0, 1.0), rtol=0, atol=1e-6)


@pytest.mark.parametrize("modification", ["shift", "abs"])
def test_rosenbrock(modification):
    x = vector(-1.2, 1.0).requires_grad_()
    optimizer = zh.optim.Newton([x], radius=0.5, modification=modification)
    for _ in range(60):
        optimizer.step(lambda: rosenbrock(x))
    torch.testing.assert_close(x.detach(), torch.ones(2, dtype=torch.float64), atol=1e-8, rtol=0)


def test_a_singular_hessian_in_float32_moves_nothing_along_its_null_space():
    x = torch.tensor([3.0, -2.0, 7.0], requires_grad=True)
    direction = torch.tensor([1.0, 2.0, 2.0]) / 3
    zh.optim.Newton([x], radius=50.0, adapt=False).step(lambda: 1e3 * (direction @ x - 1) ** 2)
    moved = x.detach() - torch.tensor([3.0, -2.0, 7.0])
    assert float(direction @ x.detach()) == pytest.approx(1.0, abs=1e-5)
    assert float((moved - (moved @ direction) * direction).norm()) < 1e-4


def test_through_a_black_box():
    bowl = Quadratic(torch.diag(vector(1.0, 4.0)), vector(-1.0, 2.0))
    layer = zh.BlackBox(bowl.f, zh.Smoothing(sigma=0.3, samples=400, seed=0))
    x = vector(5.0, 5.0).requires_grad_()
    optimizer = zh.optim.Newton([x], radius=20.0)
    for _ in range(5):
        optimizer.step(lambda: layer(x))
    torch.testing.assert_close(x.detach(), vector(1.0, -0.5), rtol=0, atol=1e-2)


def test_gauss_newton_with_the_white_box_named():
    w = vector(2.0, 0.5).requires_grad_()

    def closure():
        y = w.exp()
        return ((y - 1) ** 2).sum(), y

    optimizer = zh.optim.Newton([w], radius=10.0, curvature="gauss_newton")
    for _ in range(10):
        optimizer.step(closure)
    assert float(w.detach().abs().max()) < 1e-8


def test_errors():
    x = torch.ones(2, requires_grad=True)
    for settings, message in (
        ({"radius": -1.0}, "radius must be positive and finite, got -1.0"),
        ({"radius": math.inf}, "radius must be positive and finite, got inf"),
        ({"radius": float("nan")}, "radius"),
        ({"modification": "clip"}, "modification must be 'shift' or 'abs', got 'clip'"),
        ({"curvature": "full"}, "curvature"),
        ({"max_radius": 0.0}, "max_radius"),
    ):
        with pytest.raises(ValueError, match=message):
            zh.optim.Newton([x], **settings)
    with pytest.raises(ValueError, match="at most 10000 numbers, whose Hessian is formed, got 10001: use NewtonCG"):
        zh.optim.Newton([torch.ones(10_001, requires_grad=True)])
    with pytest.raises(TypeError, match="closure must return the loss, a tensor with a graph, got None"):
        zh.optim.Newton([x]).step(lambda: None)
    with pytest.raises(ValueError, match="closure must return a loss with a graph"):
        zh.optim.Newton([x]).step(lambda: x.detach().sum())
    with pytest.raises(ValueError, match="params must have a parameter that requires grad, got none"):
        zh.optim.Newton([x.detach()])


def test_a_step_says_whether_the_boundary_stopped_it():
    for radius, reason in ((0.5, "boundary"), (50.0, "converged")):
        x = vector(3.0, -2.0).requires_grad_()
        optimizer = zh.optim.Newton([x], radius=radius)
        optimizer.step(lambda x=x: (x**2).sum())
        assert optimizer.exit == reason


@pytest.mark.parametrize(("dtype", "n"), [(torch.bfloat16, 200), (torch.float16, 1100), (torch.float32, 1100)])
def test_many_parameters_in_half_precision_are_not_all_within_rounding(dtype, n):
    goal = torch.randn(n, generator=torch.Generator().manual_seed(0)).to(dtype)
    x, curvature = torch.zeros(n, dtype=dtype, requires_grad=True), torch.linspace(1, 3, n)
    optimizer = zh.optim.Newton([x], radius=100.0)
    first = optimizer.step(lambda: (curvature * (x.float() - goal.float()).square()).sum())
    last = (curvature * (x.detach().float() - goal.float()).square()).sum()
    assert float(last) < 1e-3 * float(first)


@pytest.mark.parametrize("narrow_first", [True, False])
def test_rounding_is_of_the_widest_type_of_the_parameters(narrow_first):
    narrow, wide = torch.zeros(5, dtype=torch.float16), torch.zeros(20, dtype=torch.float64)
    curvature = torch.logspace(0, 4, 20, dtype=torch.float64)
    params = [narrow.requires_grad_(), wide.requires_grad_()]
    optimizer = zh.optim.Newton(params if narrow_first else params[::-1], radius=100.0)
    optimizer.step(lambda: (curvature * (wide - 1).square()).sum() + (narrow.double() - 1).square().sum())
    torch.testing.assert_close(wide.detach(), torch.ones_like(wide))
    assert bool((narrow == 1).all())
