"""Steihaug's iteration against the exact trust-region solution, and Newton-CG on functions with known minima."""

import copy

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.optim.steihaug import steihaug
from truths import Quadratic


def random_problem(seed: int, spectrum: list[float]):
    generator = torch.Generator().manual_seed(seed)
    n = len(spectrum)
    q, _ = torch.linalg.qr(torch.randn(n, n, dtype=torch.float64, generator=generator))
    return q @ torch.diag(torch.tensor(spectrum, dtype=torch.float64)) @ q.mT, torch.randn(
        n, dtype=torch.float64, generator=generator
    )


@pytest.mark.parametrize("seed", range(5))
def test_interior_step_is_newtons(seed):
    H, g = random_problem(seed, [1.0, 2.0, 5.0, 9.0])
    step = steihaug(H.mv, g, 1e6, iterations=10, tolerance=1e-12)
    newton = -torch.linalg.solve(H, g)
    torch.testing.assert_close(step.s, newton)
    assert step.exit == "converged"
    assert step.decrease == pytest.approx(float(-(g @ newton + 0.5 * newton @ H @ newton)))


@pytest.mark.parametrize("spectrum", [[1.0, 2.0, 5.0], [-1.0, 2.0, 5.0], [-3.0, -2.0, -1.0]])
@pytest.mark.parametrize("radius", [1e-3, 0.1, 10.0])
def test_step_is_inside_and_as_good_as_the_cauchy_point(spectrum, radius):
    H, g = random_problem(1, spectrum)
    step = steihaug(H.mv, g, radius, iterations=20, tolerance=1e-10)
    assert float(step.s.norm()) <= radius * (1 + 1e-12)
    bend = float(g @ H @ g)
    length = radius / float(g.norm())
    if bend > 0:
        length = min(length, float(g @ g) / bend)
    cauchy = length * float(g @ g) - 0.5 * length**2 * bend
    assert step.decrease >= cauchy * (1 - 1e-12)
    assert step.decrease == pytest.approx(float(-(g @ step.s + 0.5 * step.s @ H @ step.s)))
    if min(spectrum) < 0:
        assert step.exit in ("boundary", "negative curvature")
        assert float(step.s.norm()) == pytest.approx(radius)


def test_zero_gradient_stays():
    step = steihaug(lambda v: v, torch.zeros(3), 1.0, iterations=5, tolerance=1e-3)
    assert step.exit == "converged"
    assert torch.equal(step.s, torch.zeros(3))


@pytest.mark.parametrize("condition", [1.0, 1e3, 1e6])
def test_newton_cg_solves_a_quadratic_in_one_step(condition):
    scales = torch.tensor([1.0, condition**0.5, condition], dtype=torch.float64)
    x = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.NewtonCG([x], radius=100.0, tolerance=1e-14)
    loss = optimizer.step(lambda: 0.5 * (scales * x**2).sum())
    assert float(loss) == pytest.approx(float(0.5 * (scales * torch.tensor([9.0, 4.0, 1.0])).sum()))
    assert float(x.detach().abs().max()) < 1e-8


def test_newton_cg_finds_the_minimum_of_rosenbrock():
    x = torch.tensor([-1.2, 1.0], dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.NewtonCG([x], radius=0.5)
    for _ in range(60):
        optimizer.step(lambda: (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2)
    torch.testing.assert_close(x.detach(), torch.ones(2, dtype=torch.float64), atol=1e-6, rtol=0)


def test_a_step_that_does_not_help_is_taken_back():
    x = torch.tensor([1.0], dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.NewtonCG([x], radius=4.0)
    calls = []

    def closure():
        calls.append(float(x.detach()))
        return torch.where(x < 0, 100.0, x).sum()  # a cliff behind the slope

    optimizer.step(closure)
    assert calls == [1.0, -3.0]
    assert float(x.detach()) == 1.0
    assert optimizer.param_groups[0]["radius"] == pytest.approx(1.0)


def test_newton_cg_through_a_black_box_and_a_network():
    """A network behind which a quadratic is sampled learns to map two inputs to the quadratic's minimum."""
    torch.manual_seed(0)
    net = torch.nn.Linear(3, 2).double()
    target = torch.tensor([0.3, -0.7], dtype=torch.float64)
    bowl = Quadratic(torch.eye(2, dtype=torch.float64), -target)
    layer = zh.BlackBox(bowl.f, zh.Smoothing(sigma=0.1, samples=64, seed=0))
    inputs = torch.tensor([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5]], dtype=torch.float64)
    optimizer = zh.optim.NewtonCG(net.parameters(), radius=10.0, curvature="gauss_newton")
    for _ in range(8):
        optimizer.step(lambda: layer(net(inputs)).mean())
    assert float((net(inputs) - target).detach().abs().max()) < 1e-2


def test_closure_may_name_where_the_white_box_ends():
    x = torch.tensor([1.0, 2.0], dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.NewtonCG([x], radius=10.0, curvature="gauss_newton")

    def closure():
        y = 2 * x
        return (y**2).sum(), y

    optimizer.step(closure)
    assert float(x.detach().abs().max()) < 1e-6


def test_state_dict_resumes_the_radius():
    x = torch.tensor([-1.2, 1.0], dtype=torch.float64, requires_grad=True)

    def closure():
        return (1 - x[0]) ** 2 + 100 * (x[1] - x[0] ** 2) ** 2

    optimizer = zh.optim.NewtonCG([x], radius=0.1)
    for _ in range(3):
        optimizer.step(closure)
    state, place = copy.deepcopy(optimizer.state_dict()), x.detach().clone()
    optimizer.step(closure)
    expected = x.detach().clone()
    with torch.no_grad():
        x.copy_(place)
    resumed = zh.optim.NewtonCG([x], radius=99.0)
    resumed.load_state_dict(state)
    resumed.step(closure)
    assert torch.equal(x.detach(), expected)


def test_errors():
    x = torch.ones(2, requires_grad=True)
    for settings, message in (
        ({"radius": 0.0}, "radius"),
        ({"iterations": 0}, "iterations"),
        ({"damping": -1.0}, "damping"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"curvature": "newton"}, "curvature"),
    ):
        with pytest.raises(ValueError, match=message):
            zh.optim.NewtonCG([x], **settings)
    with pytest.raises(ValueError, match="one group"):
        zh.optim.NewtonCG([{"params": [x]}, {"params": [torch.ones(1, requires_grad=True)]}])
    with pytest.raises(ValueError, match="not finite"):
        zh.optim.NewtonCG([x]).step(lambda: (x * float("nan")).sum())
    assert torch.equal(x.detach(), torch.ones(2))


def test_linear_sigma():
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=9.0))
    schedule = zh.LinearSigma([layer], 1.0, 0.2, steps=4, hold=1)
    seen = [layer.smoothing.sigma]
    for _ in range(7):
        schedule.step()
        seen.append(layer.smoothing.sigma)
    assert seen == pytest.approx([1.0, 1.0, 0.8, 0.6, 0.4, 0.2, 0.2, 0.2])
    other = zh.LinearSigma(layer, 5.0, 4.0, steps=1)
    schedule.count = 2
    other.load_state_dict(schedule.state_dict())
    assert layer.smoothing.sigma == pytest.approx(0.8)
    for settings in ({"start": 0.0}, {"end": -1.0}, {"steps": 0}, {"hold": -1}):
        arguments = {"start": 1.0, "end": 0.5, "steps": 2} | settings
        with pytest.raises(ValueError, match=next(iter(settings))):
            zh.LinearSigma(layer, **arguments)
    with pytest.raises(TypeError, match="BlackBox"):
        zh.LinearSigma([lambda z: z], 1.0, 0.5, steps=2)
