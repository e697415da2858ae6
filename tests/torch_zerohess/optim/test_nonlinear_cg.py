"""Nonlinear conjugate gradients: exact on quadratics, and on the cases in which a line search can go wrong."""

import copy

import pytest
import torch
from subproblems import random_problem, rosenbrock

import torch_zerohess as zh
from torch_zerohess.optim import NonlinearCG
from truths import vector


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("n", [1, 2, 5, 12])
def test_n_steps_solve_a_quadratic_of_n_parameters(n, dtype):
    H, b = random_problem(n, torch.linspace(1.0, 10.0, n).tolist())
    x = torch.ones(n, dtype=dtype, requires_grad=True)
    optimizer = NonlinearCG([x], radius=1e3, line_search_iterations=1, recompute=n)
    for _ in range(n):
        optimizer.step(lambda: 0.5 * x @ H.to(dtype) @ x + b.to(dtype) @ x)
    tolerance = 1e-10 if dtype == torch.float64 else 1e-3
    torch.testing.assert_close(x.detach().double(), -torch.linalg.solve(H, b), rtol=0, atol=tolerance)


def test_first_step_is_an_exact_line_search_along_the_gradient():
    H, b = random_problem(0, [1.0, 4.0])
    x = vector(1.0, -2.0).requires_grad_()
    start = x.detach().clone()
    g = H @ start + b
    loss = NonlinearCG([x], radius=100.0).step(lambda: 0.5 * x @ H @ x + b @ x)
    torch.testing.assert_close(x.detach(), start - (g @ g) / (g @ H @ g) * g)
    assert float(loss) == pytest.approx(float(0.5 * start @ H @ start + b @ start))
    assert not loss.requires_grad


def test_line_search_repeats_newton_raphson_until_the_tolerance():
    """Newton's iterates for the root of the derivative of x^4 / 4 are (2/3)^k."""
    for iterations, tolerance, moves in ((3, 0.0, 3), (9, 0.2, 3), (9, 1e-9, 9)):
        x, calls = vector(1.0).requires_grad_(), []

        def closure(x=x, calls=calls):
            calls.append(1)
            return (x**4).sum() / 4

        NonlinearCG([x], radius=5.0, line_search_iterations=iterations, line_search_tolerance=tolerance).step(closure)
        assert len(calls) == moves
        assert float(x.detach()) == pytest.approx((2 / 3) ** moves)


def test_moves_are_clipped_to_the_radius():
    x = vector(30.0, 40.0).requires_grad_()
    optimizer = NonlinearCG([x], radius=5.0, line_search_iterations=3)
    optimizer.step(lambda: (x**2).sum())
    torch.testing.assert_close(x.detach(), vector(21.0, 28.0))
    optimizer.param_groups[0]["radius"] = 1.0
    optimizer.step(lambda: (x**2).sum())
    torch.testing.assert_close(x.detach(), vector(19.2, 25.6))


@pytest.mark.parametrize("scale", [1e-12, 1.0, 1e12])
def test_negative_curvature_is_left_downhill_at_any_scale(scale):
    for modification, expected in (("abs", 6.0), ("radius", 3.5)):
        x = vector(3.0).requires_grad_()
        optimizer = NonlinearCG(
            [x], radius=100.0 if modification == "abs" else 0.5, line_search_iterations=1, modification=modification
        )
        optimizer.step(lambda x=x: -scale * (x**2).sum())
        assert float(x.detach()) == pytest.approx(expected)


@pytest.mark.parametrize("exponent", [-900, -600, 600, 900])
def test_steps_are_the_same_for_a_loss_of_any_size(exponent):
    ends = []
    for factor in (1.0, 2.0**exponent):
        x = vector(-1.2, 1.0, 0.5).requires_grad_()
        optimizer = NonlinearCG([x], radius=0.3)
        for _ in range(4):  # conjugate directions need several
            optimizer.step(lambda x=x, factor=factor: factor * (x**4 + 3 * x.roll(1) * x).sum())
        ends.append(x.detach())
    assert torch.equal(*ends)


def test_a_saddle_is_escaped():
    x = vector(2.0, 1e-3).requires_grad_()
    optimizer = NonlinearCG([x], radius=0.5, recompute=5)
    for _ in range(40):
        optimizer.step(lambda: x[0] ** 2 - x[1] ** 2 + 0.5 * x[1] ** 4)
    torch.testing.assert_close(x.detach(), vector(0.0, 1.0), rtol=0, atol=1e-6)


def test_rosenbrock():
    x = vector(-1.2, 1.0).requires_grad_()
    optimizer = NonlinearCG([x], radius=0.5, line_search_tolerance=1e-9, recompute=2)
    for _ in range(100):
        optimizer.step(lambda: rosenbrock(x))
    torch.testing.assert_close(x.detach(), torch.ones(2, dtype=torch.float64), atol=1e-6, rtol=0)


def test_a_plateau_moves_nothing_and_what_follows_is_a_restart():
    x = vector(3.0, 3.0).requires_grad_()
    optimizer = NonlinearCG([x], radius=10.0)
    flat = True
    for _ in range(3):
        optimizer.step(lambda: (0.0 * x).sum() if flat else (x**2).sum())
    assert x.tolist() == [3.0, 3.0]
    flat = False
    optimizer.step(lambda: (0.0 * x).sum() if flat else (x**2).sum())
    assert float(x.detach().abs().max()) < 1e-12


def test_a_line_without_curvature_goes_to_the_radius():
    x = vector(0.0).requires_grad_()
    NonlinearCG([x], radius=2.0, line_search_iterations=2).step(lambda: x.sum())
    assert float(x.detach()) == -4.0


def test_recompute_restarts_from_the_gradient():
    H, b = random_problem(1, [1.0, 3.0, 10.0])
    ends = []
    for recompute in (1, 9):
        x = torch.zeros(3, dtype=torch.float64, requires_grad=True)
        optimizer = NonlinearCG([x], radius=100.0, line_search_iterations=1, recompute=recompute)
        for _ in range(3):
            optimizer.step(lambda x=x: 0.5 * x @ H @ x + b @ x)
        ends.append(x.detach())
    y = torch.zeros(3, dtype=torch.float64)
    for _ in range(3):  # steepest descent
        g = H @ y + b
        y = y - (g @ g) / (g @ H @ g) * g
    torch.testing.assert_close(ends[0], y)
    torch.testing.assert_close(ends[1], -torch.linalg.solve(H, b))


def test_products_of_the_caller_take_the_place_of_the_graph():
    H, b = random_problem(2, [1.0, 3.0])
    x = torch.zeros(2, dtype=torch.float64, requires_grad=True)
    optimizer = NonlinearCG([x], radius=100.0, line_search_iterations=1)

    class Linear(torch.autograd.Function):
        """A function whose graph has first derivatives only."""

        @staticmethod
        def forward(ctx, x):
            ctx.slope = H @ x.detach() + b
            return 0.5 * x @ H @ x + b @ x

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx, gradient):
            return gradient * ctx.slope

    for _ in range(2):
        optimizer.step(lambda: Linear.apply(x), hvp=lambda v: H @ v)
    torch.testing.assert_close(x.detach(), -torch.linalg.solve(H, b))
    with pytest.raises(ValueError, match=r"hvp must return a tensor of shape \[2\], got \[\]"):
        optimizer.step(lambda: ((x - 9.0) ** 2).sum(), hvp=lambda v: v.sum())


def test_finite_differences_of_a_black_box():
    def fn(z):
        return (z**2) @ vector(1.0, 3.0)

    smoothing = zh.Smoothing(sigma=0.1, samples=50, order=1, seed=1)
    layer, x = zh.BlackBox(fn, smoothing), vector(4.0, -2.0).requires_grad_()
    optimizer = NonlinearCG([x], radius=10.0, line_search_iterations=2)
    for _ in range(8):
        optimizer.step(lambda: layer(x), hvp=lambda v: zh.finite_difference_hvp(fn, x, v, smoothing))
    assert float(x.detach().abs().max()) < 1e-3


def test_one_call_of_the_black_box_per_move():
    counted = []

    def fn(z):
        counted.append(len(z))
        return (z**4).sum(1)

    layer = zh.BlackBox(fn, zh.Smoothing(sigma=0.1, samples=3, seed=0))
    x = vector(1.0, 2.0).requires_grad_()
    NonlinearCG([x], radius=0.01, line_search_iterations=4).step(lambda: layer(x))
    assert counted == [7] * 4


def test_network_weights_and_gauss_newton():
    torch.manual_seed(0)
    net = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 2)).double()
    target = vector(0.3, -0.7)
    layer = zh.BlackBox(lambda z: ((z - target) ** 2).sum(1), zh.Smoothing(sigma=0.1, samples=32, seed=0))
    inputs = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]], dtype=torch.float64)
    optimizer = NonlinearCG(net.parameters(), radius=1.0, curvature="gauss_newton")
    for _ in range(30):
        optimizer.step(lambda: layer(net(inputs)).mean())
    assert float((net(inputs) - target).detach().abs().max()) < 1e-2


def test_a_move_to_where_the_loss_is_not_finite_is_shortened():
    """Within a line search, and at the start of the step that follows one."""
    for iterations in (1, 4):
        x = vector(4.0).requires_grad_()
        optimizer = NonlinearCG([x], radius=100.0, line_search_iterations=iterations)
        for _ in range(40):
            optimizer.step(lambda x=x: (x - 0.5 * x.log()).sum())  # minimum at 1/2, nothing below zero
        assert float(x.detach()) == pytest.approx(0.5)


def test_a_move_is_shortened_to_a_quarter():
    x, tried = vector(0.0).requires_grad_(), []

    def closure():
        tried.append(float(x.detach()))
        return torch.where(x > 0.1, torch.nan, -x).sum()

    NonlinearCG([x], radius=4.0, line_search_iterations=2).step(closure)
    assert tried == [0.0, 4.0, 1.0, 0.25, 0.0625]


def test_a_direction_that_does_not_descend_is_replaced_by_the_gradient():
    """Slopes (1, 0), then (-10, 10): -g + beta d' = (10, -10) - 200 (1, 0) goes uphill."""
    x = vector(0.0, 0.0).requires_grad_()
    optimizer = NonlinearCG([x], radius=1.0, line_search_iterations=1, recompute=100)
    optimizer.step(lambda: x[0] + 0.0 * x[1])
    torch.testing.assert_close(x.detach(), vector(-1.0, 0.0))
    optimizer.step(lambda: 10 * (x[1] - x[0]))
    torch.testing.assert_close(x.detach(), vector(0.5**0.5 - 1.0, -(0.5**0.5)))


def test_where_the_loss_is_finite_nowhere_else_the_parameters_stay():
    x = vector(1.0, 1.0).requires_grad_()
    optimizer = NonlinearCG([x], radius=2.0)
    before = copy.deepcopy(optimizer.state_dict())
    with pytest.raises(ValueError, match=r"the loss \(inf\) or its gradient is not finite, nor anywhere down to"):
        optimizer.step(lambda: torch.where(x[0] == 1.0, x.sum(), torch.inf))
    assert x.tolist() == [1.0, 1.0]
    assert optimizer.state_dict()["state"] == before["state"]
    with pytest.raises(ValueError, match=r"the loss \(nan\) or its gradient is not finite; no step"):
        optimizer.step(lambda: torch.nan * x.sum())
    with pytest.raises(ValueError, match="curvature of the loss is not finite"):
        optimizer.step(lambda: x.sum(), hvp=lambda v: v * torch.nan)
    assert x.tolist() == [1.0, 1.0]


def test_what_the_closure_raises_leaves_parameters_and_state():
    x = vector(1.0, 2.0).requires_grad_()
    optimizer = NonlinearCG([x], radius=0.1, line_search_tolerance=0.0)
    optimizer.step(lambda: rosenbrock(x))
    place, state, calls = x.detach().clone(), copy.deepcopy(optimizer.state_dict()), []

    def dies():
        calls.append(1)
        if len(calls) == 3:
            raise RuntimeError("the renderer died")
        return rosenbrock(x)

    with pytest.raises(RuntimeError, match="renderer died"):
        optimizer.step(dies)
    assert torch.equal(x.detach(), place)
    for name, value in optimizer.state_dict()["state"][0].items():
        torch.testing.assert_close(value, state["state"][0][name], rtol=0, atol=0)


def test_errors():
    x = torch.ones(2, requires_grad=True)
    for settings, message in (
        ({"radius": 0.0}, "radius must be positive and finite, got 0.0"),
        ({"line_search_iterations": 0}, "line_search_iterations must be at least 1, got 0"),
        ({"line_search_tolerance": -1.0}, "line_search_tolerance must be at least 0 and finite, got -1.0"),
        ({"recompute": 0}, "recompute must be at least 1, got 0"),
        ({"curvature": "hessian"}, "curvature must be"),
        ({"modification": "cube"}, "modification must be 'abs' or 'radius', got 'cube'"),
    ):
        with pytest.raises(ValueError, match=message):
            NonlinearCG([x], **settings)
    with pytest.raises(TypeError, match=r"recompute must be an integer, got 2.5"):
        NonlinearCG([x], recompute=2.5)
    with pytest.raises(ValueError, match="one group"):
        NonlinearCG([{"params": [x]}, {"params": [torch.ones(1, requires_grad=True)]}])


@pytest.mark.parametrize("narrow_first", [True, False])
def test_products_of_the_caller_get_vectors_of_the_widest_type(narrow_first):
    narrow, wide = torch.ones(2, dtype=torch.float16), torch.ones(3, dtype=torch.float64)
    params, types = [narrow.requires_grad_(), wide.requires_grad_()], set()

    def product(v):
        types.add(v.dtype)
        return 2 * v

    optimizer = zh.optim.NonlinearCG(params if narrow_first else params[::-1])
    optimizer.step(lambda: wide.square().sum() + narrow.double().square().sum(), hvp=product)
    assert types == {torch.float64}
