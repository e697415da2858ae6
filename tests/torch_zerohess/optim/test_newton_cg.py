"""Steihaug's iteration against the exact trust-region solution, and Newton-CG on functions with known minima."""

import pytest
import torch
from subproblems import random_problem, rosenbrock
from torch.nn.attention import SDPBackend, sdpa_kernel

import torch_zerohess as zh
from torch_zerohess.linalg.steihaug import noise_level, steihaug
from truths import Quadratic


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


def test_a_curvature_that_is_too_small_to_divide_by_leads_to_the_boundary():
    gradient = torch.tensor([1.0, 0.0], dtype=torch.float64)
    step = steihaug(lambda v: 1e-320 * v, gradient, 2.0, iterations=5, tolerance=1e-6)
    torch.testing.assert_close(step.s, -2.0 * gradient)
    assert step.decrease == 2.0


@pytest.mark.parametrize("spectrum", [[1.0, 2.0, 5.0], [-1.0, 2.0, 5.0]])
@pytest.mark.parametrize("exponent", [-900, -600, 600, 900])
def test_the_step_is_the_same_for_a_loss_of_any_size(spectrum, exponent):
    """Squares of such gradients are zero or infinite."""
    (H, g), factor = random_problem(1, spectrum), 2.0**exponent
    for radius in (0.1, 10.0):
        step = steihaug(H.mv, g, radius, iterations=20, tolerance=1e-10)
        scaled = steihaug((factor * H).mv, factor * g, radius, iterations=20, tolerance=1e-10)
        assert torch.equal(scaled.s, step.s)
        assert (scaled.decrease, scaled.exit) == (factor * step.decrease, step.exit)


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
        optimizer.step(lambda: rosenbrock(x))
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


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("make", "other"),
    [
        (lambda p: zh.optim.NewtonCG(p, radius=0.1), lambda p: zh.optim.NewtonCG(p, radius=99.0)),
        (lambda p: zh.optim.Newton(p, radius=0.1, modification="abs"), lambda p: zh.optim.Newton(p, radius=99.0)),
        (
            lambda p: zh.optim.NonlinearCG(p, radius=0.1, recompute=4),
            lambda p: zh.optim.NonlinearCG(p, radius=99.0, line_search_iterations=1),
        ),
    ],
    ids=["NewtonCG", "Newton", "NonlinearCG"],
)
def test_state_dict_resumes_to_the_bit(make, other, dtype, tmp_path):
    def parameters():
        return [torch.tensor(start, dtype=dtype, requires_grad=True) for start in ([-1.2, 1.0], [[0.3]])]

    def run(optimizer, p, steps):
        generator = torch.Generator()
        for step in steps:
            generator.manual_seed(step)
            noise = 0.1 * torch.randn(2, dtype=dtype, generator=generator)
            optimizer.step(lambda n=noise: (p[1][0, 0] - p[0][0]) ** 2 + 10 * (p[0][1] - p[0][0] ** 2) ** 2 + n @ p[0])

    whole, half = parameters(), parameters()
    run(make(whole), whole, range(9))
    optimizer = make(half)
    run(optimizer, half, range(5))
    torch.save(([p.detach() for p in half], optimizer.state_dict()), tmp_path / "state.pt")
    place, state = torch.load(tmp_path / "state.pt")
    resumed = [p.clone().requires_grad_() for p in place]
    optimizer = other(resumed)
    optimizer.load_state_dict(state)
    run(optimizer, resumed, range(5, 9))
    for one, expected in zip(resumed, whole, strict=True):
        assert torch.equal(one.detach(), expected.detach())


def noisy_bowl(x, scales, generator):
    """Eight losses whose mean is sum(scales x^2)/2, but for errors of their gradients."""
    slopes = 0.1 * torch.randn(8, len(x), dtype=x.dtype, generator=generator)
    return 0.5 * (scales * x**2).sum() + slopes @ x


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_noise_is_not_amplified_in_flat_directions(dtype):
    """The gradient has an error of 0.035 in each element: divided by a curvature of 1e-4 that is a step of 350.

    Of 40 steps from one place, those that go astray along the flat half: nearly all where noise is taken for gradient,
    otherwise the few whose noise stands out by two standard deviations, estimated from eight (below 5 %).
    """
    scales = torch.tensor([100.0, 50.0, 1e-4, 1e-4], dtype=dtype)
    astray = {}
    for noise in (0.0, 2.0):
        generator = torch.Generator().manual_seed(0)
        astray[noise] = 0
        for _ in range(40):
            x = torch.ones(4, dtype=dtype, requires_grad=True)
            optimizer = zh.optim.NewtonCG([x], radius=1e4, tolerance=1e-6, adapt=False, noise=noise)
            optimizer.step(lambda x=x, generator=generator: noisy_bowl(x, scales, generator))
            assert float(x.detach()[:2].abs().max()) < 0.01
            astray[noise] += float((x.detach()[2:] - 1).abs().max()) > 10
    assert astray[0.0] >= 36
    assert astray[2.0] <= 6


def test_stopping_at_the_noise_costs_nothing_where_there_is_none():
    x = torch.tensor([3.0, -2.0, 1.0], dtype=torch.float64, requires_grad=True)
    scales = torch.tensor([1.0, 30.0, 900.0], dtype=torch.float64)
    optimizer = zh.optim.NewtonCG([x], radius=100.0, tolerance=1e-14)
    optimizer.step(lambda: (0.5 * (scales * x**2).sum()).expand(5))
    assert float(x.detach().abs().max()) < 1e-8


@pytest.mark.parametrize(("N", "rank"), [(1, 1), (3, 3), (400, 400), (400, 2)])
def test_noise_level_is_seldom_exceeded_by_noise(N, rank):
    """Two standard deviations of eight normal numbers: 9 % of 400, 36 (t distribution), plus four standard errors."""
    generator = torch.Generator().manual_seed(N + rank)
    basis = torch.randn(rank, N, dtype=torch.float64, generator=generator)
    exceeded = 0
    for _ in range(400):
        estimates = torch.randn(8, rank, dtype=torch.float64, generator=generator) @ basis
        level = noise_level(estimates, 2.0)
        error = float(estimates.var(0).sum() / 8) ** 0.5
        assert error <= level <= 2.0 * error
        exceeded += float(estimates.mean(0).norm()) > level
    assert exceeded <= 60
    assert noise_level(estimates, 0.0) == noise_level(estimates[:1], 2.0) == 0.0


def test_curvature_that_is_noise_is_not_divided_by():
    """Along a straight slope the sampled curvature is zero but for its error: the step is as long as that allows."""
    images = torch.tensor([1.0, -1.0, 2.0, -2.1], dtype=torch.float64)
    gradient = torch.ones(4, 1, dtype=torch.float64)
    step = steihaug(lambda v: images[:, None] * v, gradient, 100.0, iterations=5, tolerance=1e-6, noise=2.0)
    error = float((images.var() / 4 * (1 + 2 * 2**0.5)).sqrt())
    assert step.exit == "noise"
    assert float(step.s) == pytest.approx(-1.0 / error)
    step = steihaug(lambda v: images[:, None] * v, gradient, 100.0, iterations=5, tolerance=1e-6)
    assert step.exit == "negative curvature"
    assert float(step.s) == -100.0


def test_a_second_direction_whose_curvature_is_noise_is_not_followed():
    """Along the first axis the curvature is 10; along the second one it is zero but for its error."""
    images = torch.tensor([1.0, -1.0, 2.0, -2.1], dtype=torch.float64)

    def product(v):
        return torch.stack([10.0 * v[0].expand(4), images * v[1]], 1)

    g = torch.tensor([1.0, 0.1], dtype=torch.float64)
    step = steihaug(product, g.expand(4, 2), 100.0, iterations=5, tolerance=1e-6, noise=2.0)
    length = float(g @ g) / float(g @ product(g).mean(0))  # of the exact line search along the first direction
    assert step.exit == "noise"
    torch.testing.assert_close(step.s, -length * g)


def test_noise_of_a_sampled_black_box():
    """At the minimum of a bowl with a flat direction, sampled with outliers: steps stay short."""
    scales = torch.tensor([10.0, 1e-5], dtype=torch.float64)
    moved = {}
    for noise in (0.0, 2.0):
        layer = zh.BlackBox(
            lambda z: z**2 @ scales + 0.1 * torch.sin(1e4 * z.sum(1)), zh.Smoothing(sigma=0.1, samples=4)
        )
        torch.manual_seed(0)
        x = torch.zeros(2, dtype=torch.float64, requires_grad=True)
        optimizer = zh.optim.NewtonCG([x], radius=1e3, adapt=False, noise=noise, curvature="exact")
        longest = 0.0
        for _ in range(10):
            optimizer.step(lambda x=x, layer=layer: layer(x.expand(8, 2)))
            longest = max(longest, float(x.detach().norm()))
            with torch.no_grad():
                x.zero_()
        moved[noise] = longest
    assert moved[0.0] > 10
    assert moved[2.0] < 1


def test_errors():
    x = torch.ones(2, requires_grad=True)
    for settings, message in (
        ({"radius": 0.0}, "radius"),
        ({"iterations": 0}, "iterations"),
        ({"damping": -1.0}, "damping"),
        ({"tolerance": 0.0}, "tolerance"),
        ({"curvature": "newton"}, "curvature"),
        ({"noise": -1.0}, "noise must be at least 0 and finite, got -1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            zh.optim.NewtonCG([x], **settings)
    with pytest.raises(ValueError, match="one group"):
        zh.optim.NewtonCG([{"params": [x]}, {"params": [torch.ones(1, requires_grad=True)]}])
    with pytest.raises(ValueError, match="one group"):
        zh.optim.NewtonCG([x]).add_param_group({"params": [torch.ones(1, requires_grad=True)]})
    with pytest.raises(ValueError, match=r"no settings of their own, got weight_decay: for a weight decay w add w / 2"):
        zh.optim.NewtonCG([{"params": [x], "weight_decay": 0.1}])
    with pytest.raises(ValueError, match="not finite"):
        zh.optim.NewtonCG([x]).step(lambda: (x * float("nan")).sum())
    assert torch.equal(x.detach(), torch.ones(2))


def test_damping_is_added_to_the_curvature():
    x = torch.tensor([3.0, -2.0], dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.NewtonCG([x], radius=100.0, tolerance=1e-12, damping=6.0, adapt=False)
    optimizer.step(lambda: (x**2).sum())  # (2 + 6) s = -2 x
    torch.testing.assert_close(x.detach(), 0.75 * torch.tensor([3.0, -2.0], dtype=torch.float64))


def test_a_loss_in_place_of_a_closure_is_named() -> None:
    x = torch.ones(2, requires_grad=True)
    with pytest.raises(TypeError, match="closure must be callable, a function that returns the loss, got None"):
        zh.optim.NewtonCG([x]).step(None)
    with pytest.raises(TypeError, match="adapt must be True or False, got 'x'"):
        zh.optim.NewtonCG([x], adapt="x")


class Attending(torch.nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.inner, self.last = torch.nn.MultiheadAttention(4, 1, batch_first=True), torch.nn.Linear(4, 2)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return self.last(self.inner(x, x, x, need_weights=False)[0][:, 0])


def test_a_network_with_attention_in_plain_operations() -> None:
    torch.manual_seed(0)
    network, x = Attending(), torch.randn(8, 3, 4)
    layer = zh.BlackBox(lambda z: (z - 1.0).square().sum(1), zh.Smoothing(sigma=0.1, samples=16))
    optimizer = zh.optim.NewtonCG(network.parameters(), radius=0.5, curvature="gauss_newton")
    with sdpa_kernel(SDPBackend.MATH):
        losses = [float(optimizer.step(lambda: layer(network(x)).mean())) for _ in range(8)]
    assert losses[-1] < 0.1 * losses[0]


@pytest.mark.parametrize(("curvature", "damping"), [("exact", 0.0), ("gauss_newton", 0.3)])
def test_weight_decay_in_the_closure_ends_at_the_ridge_solution(curvature, damping):
    """One step to theta = (A^T A + w I)^-1 A^T b. With "gauss_newton" the damping stands for the curvature of w."""
    draws, w = torch.Generator().manual_seed(0), 0.3
    A, b = (torch.randn(*shape, generator=draws, dtype=torch.float64) for shape in ((6, 3), (6,)))
    theta = torch.ones(3, dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.NewtonCG([theta], radius=1e3, curvature=curvature, damping=damping, tolerance=1e-12)

    def closure():
        y = A @ theta
        loss = 0.5 * (y - b).square().sum() + 0.5 * w * theta.square().sum()
        return (loss, y) if curvature == "gauss_newton" else loss

    optimizer.step(closure)
    expected = torch.linalg.solve(A.mT @ A + w * torch.eye(3, dtype=A.dtype), A.mT @ b)
    assert float((theta.detach() - expected).norm()) < 1e-9
