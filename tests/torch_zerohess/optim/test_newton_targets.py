"""Newton targets against the minima of quadratics, dense solves with `torch.func.hessian`, and a network's training."""

import pytest
import torch
from torch.func import grad, hessian, vmap

import torch_zerohess as zh
from torch_zerohess.optim.newton_targets import NewtonTargets


def quadratics(n):
    """Matrices [3, n, n] of condition 1e4, minima [3, n], and the losses of rows."""
    generator = torch.Generator().manual_seed(0)
    bases = torch.linalg.qr(torch.randn(3, n, n, generator=generator, dtype=torch.float64))[0]
    matrices = bases * torch.logspace(0, 4, n, dtype=torch.float64) @ bases.mT
    minima = torch.randn(3, n, generator=generator, dtype=torch.float64)

    def losses(y):
        d = y - minima[: len(y)]
        return 0.5 * torch.einsum("bi,bij,bj->b", d, matrices[: len(y)], d)

    return matrices, minima, losses


@pytest.mark.parametrize("n", [1, 5, 16])
def test_few_outputs_reach_the_minima_of_quadratics(n):
    _, minima, losses = quadratics(n)
    found = NewtonTargets(relative_damping=1e-12)(losses, torch.zeros(3, n, dtype=torch.float64))
    torch.testing.assert_close(found, minima, rtol=1e-5, atol=1e-5)


def test_many_outputs_of_one_curvature_take_one_iteration():
    matrices, minima, _ = quadratics(40)
    losses = lambda y: 0.5 * torch.einsum("bi,ij,bj->b", y - minima, matrices[0], y - minima)  # noqa: E731
    targets = NewtonTargets(relative_damping=1e-12, iterations=1)
    torch.testing.assert_close(targets(losses, torch.zeros(3, 40, dtype=torch.float64)), minima, rtol=1e-4, atol=1e-4)


def test_many_outputs_of_different_curvature_leave_a_residual_of_one_percent():
    matrices, minima, losses = quadratics(24)
    y = torch.ones(3, 24, dtype=torch.float64)
    found = NewtonTargets(relative_damping=1e-9, iterations=400)(losses, y)
    before, after = ((matrices @ (at - minima)[..., None]).norm(dim=1) for at in (y, found))
    assert bool((after < 0.011 * before).all())


def test_negative_curvature_is_descended():
    losses = lambda y: (y[:, 0] ** 2 - 3 * y[:, 1] ** 2) / 2 + y[:, 1] ** 4  # noqa: E731
    y = torch.tensor([[0.5, 0.1], [-0.5, -0.1]], dtype=torch.float64)
    found = NewtonTargets(relative_damping=1e-9)(losses, y)
    h, g = vmap(hessian(lambda p: losses(p[None])[0]))(y), vmap(grad(lambda p: losses(p[None])[0]))(y)
    torch.testing.assert_close(found, y - g / h.diagonal(dim1=1, dim2=2).abs())
    many = lambda y: (y[:, ::2] ** 2).sum(1) - 0.5 * (y[:, 1::2] ** 2).sum(1)  # noqa: E731
    start = torch.full((2, 20), 0.1, dtype=torch.float64)
    assert bool((many(NewtonTargets()(many, start)) < many(start)).all())


def test_the_damping_of_few_outputs_is_relative_to_the_magnitudes_of_the_eigenvalues():
    """H = [[1, 2], [2, 1]], whose diagonal has the mean 1, has the eigenvalues 3 and -1: |H| = [[2, 1], [1, 2]]."""
    losses = lambda y: 0.5 * y.square().sum(1) + 2 * y.prod(1)  # noqa: E731
    y = torch.tensor([[0.5, 0.1]], dtype=torch.float64)
    h = torch.tensor([[2.0, 1.0], [1.0, 2.0]], dtype=torch.float64) + 0.25 * 2.0 * torch.eye(2, dtype=torch.float64)
    g = grad(lambda p: losses(p[None])[0])(y[0])
    found = NewtonTargets(relative_damping=0.25)(losses, y)
    torch.testing.assert_close(found, y - torch.linalg.solve(h, g))


SADDLES = {
    "products": lambda y: (y[:, 0::2] * y[:, 1::2]).sum(1),
    "squares": lambda y: 0.5 * (y[:, 0::2] ** 2 - y[:, 1::2] ** 2).sum(1),
}


@pytest.mark.parametrize("losses", SADDLES.values(), ids=SADDLES.keys())
@pytest.mark.parametrize("n", [16, 18, 20, 32])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_steps_at_saddles_whose_curvature_is_balanced(losses, n: int, dtype: torch.dtype) -> None:
    """The eigenvalues of H are 1 and -1, so that |H| is the identity, and the trace of H is 0."""
    y = torch.randn(64, n, generator=torch.Generator().manual_seed(0), dtype=dtype)
    y[:, 0] = 1.01
    g = vmap(grad(lambda p: losses(p[None])[0]))(y)
    targets = NewtonTargets(relative_damping=0.25)
    for _ in range(2):
        torch.testing.assert_close(targets(losses, y), y - g / 1.25, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("relative_damping", [1e-3, 0.1])
def test_steps_on_different_indefinite_quadratics_are_about_as_long_as_those_of_the_magnitudes(
    relative_damping: float,
) -> None:
    a = torch.randn(32, 40, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    h = a + a.mT
    y = torch.randn(32, 40, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = NewtonTargets(relative_damping=relative_damping)(lambda y: 0.5 * torch.einsum("bi,bij,bj->b", y, h, y), y)
    values, vectors = torch.linalg.eigh(h)
    size = values.abs() + relative_damping * values.abs().mean(1, keepdim=True)
    slope = vectors.mT @ (h @ y[..., None])
    expected = (vectors @ (slope / size[..., None]))[..., 0]
    step = y - found
    lengths = step.norm(dim=1) / expected.norm(dim=1)
    assert bool(((lengths > 0.3) & (lengths < 4.0)).all())
    assert bool(((step * expected).sum(1) > 0.0).all())


def test_steps_are_at_most_the_radius():
    _, minima, losses = quadratics(5)
    found = NewtonTargets(relative_damping=1e-12, output_radius=0.25)(losses, torch.zeros(3, 5, dtype=torch.float64))
    torch.testing.assert_close(found, 0.25 * minima / minima.norm(dim=1, keepdim=True), rtol=1e-4, atol=1e-4)


def test_a_network_learns_through_an_ill_conditioned_layer():
    """The same steps of Adam: on the loss itself the weak output is not learned."""
    scale, inputs = torch.tensor([1.0, 1e-3]), torch.randn(64, 3, generator=torch.Generator().manual_seed(0))
    truth = inputs @ torch.tensor([[1.0, 0.5], [-0.5, 1.0], [0.2, -1.0]])
    errors = []
    for newton in (False, True):
        torch.manual_seed(0)
        network, targets = torch.nn.Linear(3, 2), NewtonTargets(relative_damping=1e-8)
        layer = zh.BlackBox(lambda z: scale * z, zh.Smoothing(sigma=0.1, samples=16, order=2))
        optimizer = torch.optim.SGD(network.parameters(), lr=0.3)
        for _ in range(60):
            y = network(inputs)
            losses = lambda q, layer=layer: (layer(q) - scale * truth).square().sum(1)  # noqa: E731
            loss = 0.5 * (y - targets(losses, y)).square().sum(1).mean() if newton else losses(y).mean()
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        errors.append(float((network(inputs).detach() - truth)[:, 1].square().mean()))
    assert errors[1] < 0.05 < 0.5 < errors[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"relative_damping": 0.0}, "relative_damping must be positive, got 0.0"),
        ({"output_radius": -1.0}, "output_radius must be positive, got -1.0"),
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
    ],
)
def test_settings_are_checked(arguments, message):
    with pytest.raises(ValueError, match=message):
        NewtonTargets(**arguments)


def test_losses_and_outputs_are_checked():
    targets = NewtonTargets()
    with pytest.raises(ValueError, match=r"y must be \[B, n\], got \[3\]"):
        targets(lambda y: y, torch.zeros(3))
    with pytest.raises(ValueError, match=r"losses\(y\) must be \[2\], one for each element, got \[\]"):
        targets(lambda y: y.square().mean(), torch.zeros(2, 3))
    with pytest.raises(ValueError, match=r"losses\(y\) has no graph back to y"):
        targets(lambda y: y.detach().square().sum(1), torch.ones(2, 3))
    with pytest.raises(ValueError, match="is not finite"):
        targets(lambda y: (y * torch.inf).square().sum(1), torch.ones(2, 3))


def test_many_outputs_are_damped_by_the_size_of_their_own_hessian() -> None:
    """Quadratics a |y - 3|^2 with h = 2 a, one object for all calls: t = 3 (1 - damping / (1 + damping))."""
    targets, y = NewtonTargets(relative_damping=0.1), torch.zeros(4, 20)
    for size in (100.0, 1.0, 0.01):
        a = size * torch.tensor([1e-2, 1.0, 1e2, 10.0])
        found = targets(lambda y, a=a: a * (y - 3.0).square().sum(1), y)
        torch.testing.assert_close(found, torch.full_like(y, 3.0 / 1.1), rtol=1e-3, atol=0.0)


def test_wrong_outputs_say_so_and_none_have_no_targets() -> None:
    targets = NewtonTargets()
    for y, error, message in (
        ([[1.0]], TypeError, "y must be a tensor, got list"),
        (
            torch.zeros(2, 3, dtype=torch.long),
            ValueError,
            r"y must be of floating point, got torch.int64",
        ),
        (torch.zeros(2), ValueError, r"y must be \[B, n\], got \[2\]"),
    ):
        with pytest.raises(error, match=message):
            targets(lambda y: y.sum(1), y)
    with torch.inference_mode(), pytest.raises(RuntimeError, match=r"inference mode forbids: use torch\.no_grad"):
        targets(lambda y: y.square().sum(1), torch.zeros(2, 3))
    for shape in ((0, 17), (0, 2), (2, 0)):
        assert targets(lambda y: y.square().sum(1), torch.zeros(shape)).shape == shape
        assert targets.losses.shape == shape[:1]


def test_an_element_on_a_plateau_stays_while_others_move() -> None:
    """Twenty outputs, so that the solve is iterative: one gradient is zero, and the others take several iterations."""
    losses = quadratics(20)[2]
    with_plateau = torch.tensor([0.0, 1.0, 1.0], dtype=torch.float64)
    y = torch.zeros(3, 20, dtype=torch.float64)
    targets = NewtonTargets(relative_damping=1e-6, output_radius=1e3)(lambda y: with_plateau[: len(y)] * losses(y), y)
    assert float(targets[0].abs().max()) == 0.0
    assert bool(torch.isfinite(targets).all())
    assert float(losses(targets)[1:].max()) < 0.1 * float(losses(y)[1:].min())


@pytest.mark.parametrize("n", [1, 3, 20])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("scale", [1.0, 1e20])
def test_where_the_hessian_is_rounding_the_step_is_the_gradient(n: int, dtype: torch.dtype, scale: float) -> None:
    """An element whose loss is linear, but for curvature of the size of rounding; the other one is a quadratic."""
    generator = torch.Generator().manual_seed(0)
    slope, y = (torch.randn(2, n, generator=generator, dtype=torch.float64).to(dtype) for _ in range(2))
    rounding = torch.finfo(dtype).eps

    def losses(y):
        bent = torch.stack([rounding * y[0].square().sum(), 50.0 * (y[1] - 3.0).square().sum()])
        return scale * ((slope * (y + 0.3)).sum(1) * torch.tensor([1.0, 0.0]).to(y) + bent)

    step = y - NewtonTargets(relative_damping=1e-9)(losses, y)
    torch.testing.assert_close(step[0] / scale, slope[0], atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(y[1] - step[1], torch.full((n,), 3.0, dtype=dtype), atol=1e-4, rtol=0.0)


def test_the_targets_of_a_linear_black_box_are_gradient_steps() -> None:
    """Its sampled Hessian is about 1e-16."""
    layer = zh.BlackBox(lambda z: (z - 0.3).sum(1), zh.Smoothing(sigma=0.3, samples=2, seed=5))
    y = torch.randn(4, 1, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    (slope,) = torch.autograd.grad(layer(y.requires_grad_()).sum(), y)
    torch.testing.assert_close(NewtonTargets()(layer, y), y.detach() - slope)


@pytest.mark.parametrize("n", [3, 20])
@pytest.mark.parametrize("least", [0.0, -3.999999])
def test_a_hessian_of_outputs_or_losses_near_zero_is_no_rounding(n: int, least: float) -> None:
    """Outputs of 1e-10 are far from a minimum at 3; at outputs of 1, the other loss is n 1e-6."""
    y = torch.full((2, n), 1e-10 if least == 0.0 else 1.0)
    found = NewtonTargets(relative_damping=1e-6)(lambda y: (y - 3.0).square().sum(1) + n * least, y)
    torch.testing.assert_close(found, torch.full_like(y, 3.0), rtol=1e-4, atol=0.0)


COUPLED = {
    "all": lambda y: (y - y.mean(0)).square().sum(1),
    "two": lambda y: y.square().sum(1) + torch.stack([y[2, 0] * y[0, 0], *(0.0 * y[1:, 0])]),
    "linear": lambda y: (y - 1.0).square().sum(1) + 3.0 * y.roll(1, 0).sum(1),
    "linear in two": lambda y: y.square().sum(1) + torch.stack([y[2, 0], *(0.0 * y[1:, 0])]),
}


@pytest.mark.parametrize("coupled", COUPLED.values(), ids=COUPLED.keys())
@pytest.mark.parametrize("n", [3, 20])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_losses_that_couple_elements_are_refused(coupled, n: int, dtype: torch.dtype) -> None:
    targets, y = NewtonTargets(), torch.randn(5, n, generator=torch.Generator().manual_seed(0), dtype=dtype)
    for _ in range(2):
        with pytest.raises(ValueError, match=r"losses\(y\) must be each of its own element"):
            targets(coupled, y)
    assert targets(lambda y: y.sum(1).square(), y).shape == y.shape  # a curvature of rank 1


@pytest.mark.parametrize("coupled", COUPLED.values(), ids=COUPLED.keys())
@pytest.mark.parametrize("n", [3, 20])
def test_losses_are_checked_in_every_call(coupled, n: int) -> None:
    targets, y = NewtonTargets(), torch.randn(5, n, generator=torch.Generator().manual_seed(0))
    for good in (y[:1], y):
        targets(lambda y: y.square().sum(1), good)
        with pytest.raises(ValueError, match=r"losses\(y\) must be each of its own element"):
            targets(coupled, y)


@pytest.mark.parametrize("n", [3, 20])
def test_second_derivatives_that_couple_elements_are_refused(n: int) -> None:
    """Where the outputs are zero, the gradient does not show that they are multiplied."""
    targets, y = NewtonTargets(), torch.zeros(5, n)
    targets(lambda y: y.square().sum(1), y)
    with pytest.raises(ValueError, match=r"losses\(y\) must be each of its own element"):
        targets(COUPLED["two"], y)


class Rounded(torch.autograd.Function):
    """A sum over each row, whose backward pass rounds in another way each time."""

    @staticmethod
    def forward(ctx, y):
        ctx.shape = y.shape
        return y.sum(1)

    @staticmethod
    def backward(ctx, g):
        return g[:, None] * (1.0 + 1e-6 * torch.randn(ctx.shape))


ROUNDING = {
    "of each pass": (torch.float32, lambda y: 1e3 * (Rounded.apply(y) - y.sum(1))),
    "of products": (torch.float32, lambda y: 1e3 * (torch.pi * (torch.e * y).sum(1) - (torch.pi * torch.e) * y.sum(1))),
    "of half precision": (torch.float16, lambda y: 1e-6 * y.sum(1)),
}


@pytest.mark.parametrize("n", [3, 20])
@pytest.mark.parametrize(("dtype", "added"), ROUNDING.values(), ids=ROUNDING.keys())
def test_rounding_at_a_minimum_is_not_taken_for_other_elements(added, dtype: torch.dtype, n: int) -> None:
    """All of the gradient is rounding."""
    torch.manual_seed(0)
    y = torch.full((12, n), 3.0, dtype=dtype)
    for _ in range(20):
        found = NewtonTargets()(lambda y: (y - 3.0).square().sum(1) + added(y), y)
        torch.testing.assert_close(found, y, rtol=0.0, atol=0.02)


LAYERS = {
    "auto": lambda: zh.BlackBox(torch.round, zh.Smoothing.auto(sigma=0.5, samples=16)),
    "without pairs": lambda: zh.BlackBox(torch.round, zh.Smoothing(sigma=0.5, samples=8, antithetic=False)),
    "noise": lambda: zh.BlackBox(lambda z: z + torch.randn_like(z), zh.Smoothing(sigma=0.5, samples=8)),
    "sparse": lambda: zh.SparseBlackBox(torch.round, zh.Smoothing(sigma=0.5, samples=40)),
}
HEADS = {"squares": zh.heads.SquaredError(), "entropy": zh.heads.LocalEntropy(zh.heads.SquaredError(), 0.5)}


@pytest.mark.parametrize(("n", "dtype"), [(3, torch.float32), (20, torch.float64)])
def test_sampled_losses_are_of_their_own_elements(n: int, dtype: torch.dtype) -> None:
    """No layer is refused, from the first call to the last, near a minimum."""
    torch.manual_seed(0)
    wanted = torch.randn(10, n, dtype=dtype)
    layers = {name: make() for name, make in LAYERS.items()}
    losses = {name: lambda y, name=name: (layers[name](y) - wanted).square().sum(1) for name in layers}
    for name, head in HEADS.items():
        for memory in (None, zh.Memory(fresh=2)):
            layer = zh.BlackBox(torch.sin, zh.Smoothing(sigma=0.5, samples=4), head=head, memory=memory)
            losses[f"{name} {memory}"] = lambda y, layer=layer: layer(y, wanted)
    for one in losses.values():
        targets, y = NewtonTargets(relative_damping=0.1, output_radius=0.5), torch.zeros(10, n, dtype=dtype)
        for _ in range(5):
            y = targets(one, y)
        assert bool(torch.isfinite(y).all())


@pytest.mark.parametrize("n", [3, 20])
@pytest.mark.parametrize("scale", [1e-30, 1e25])
def test_the_scale_of_the_losses_does_not_matter(n: int, scale: float) -> None:
    y = torch.linspace(-1.0, 1.0, 2 * n).view(2, n)
    found = NewtonTargets(relative_damping=1e-6)(lambda y: scale * (y - 3.0).square().sum(1), y)
    torch.testing.assert_close(found, torch.full_like(y, 3.0), rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("n", [3, 20])
def test_a_step_of_any_length_is_shortened_to_the_radius(n: int) -> None:
    found = NewtonTargets(output_radius=2.0)(lambda y: (y - 1e25).square().sum(1), torch.zeros(2, n))
    torch.testing.assert_close(found.norm(dim=1), torch.full((2,), 2.0))


def of_scales(*scales):
    """Quadratics of these scales [B, n] of the outputs, with minima at 1."""
    c = torch.stack(scales)
    return lambda y: (c * (y - 1.0)).square().sum(1)


def test_a_preconditioner_is_made_again_as_soon_as_the_curvature_has_changed() -> None:
    """Sixty-four outputs, whose scales turn round again and again: each call finds the minimum."""
    scales, y = torch.logspace(0, 1.5, 64), torch.zeros(8, 64)
    targets = NewtonTargets(relative_damping=1e-6)
    for c in (scales, scales.flip(0), scales.flip(0), scales.roll(32), scales):
        torch.testing.assert_close(targets(of_scales(*[c] * 8), y), torch.ones_like(y), rtol=1e-3, atol=0.0)


class Counted(torch.autograd.Function):
    """The identity, which counts backward passes: one per gradient and one per product."""

    passes = 0

    @staticmethod
    def forward(ctx, y):
        return y.clone()

    @staticmethod
    def backward(ctx, g):
        Counted.passes += 1
        return g


def test_a_preconditioner_that_does_not_help_is_made_once_in_a_hundred_calls() -> None:
    """Two elements of opposite scales: one matrix suits neither of them in two iterations."""
    losses, y = of_scales(scales := torch.logspace(0, 1.5, 20), scales.flip(0)), torch.zeros(2, 20)
    targets, passes = NewtonTargets(relative_damping=1e-6, iterations=2), []
    for _ in range(203):
        Counted.passes = 0
        targets(lambda y: losses(Counted.apply(y)), y)
        passes.append(Counted.passes)
    ordinary = min(passes)
    assert [k for k, one in enumerate(passes) if one > ordinary] == [0, 101, 202]
    assert passes[0] == ordinary + 10  # columns of two elements at a time
    assert passes[101] == ordinary + 10 + 2  # and the iterations before and after it


@pytest.mark.parametrize("iterations", [1, 16])
def test_targets_resume_to_the_bit(iterations: int, tmp_path) -> None:
    """Whether preconditioners help or not, which they do not in one iteration."""
    scales, y = torch.logspace(0, 1.5, 40), torch.linspace(-1.0, 1.0, 80).view(2, 40)
    losses = of_scales(scales, 1.1 * scales.roll(1))
    settings = {"relative_damping": 1e-6, "iterations": iterations}
    targets = NewtonTargets(**settings)
    targets(of_scales(scales, scales), y)
    if iterations == 1:
        targets(of_scales(scales.roll(9), scales), y)  # it helps no more: 100 calls have no other
    torch.save(targets.state_dict(), tmp_path / "targets.pt")
    resumed = NewtonTargets(**settings)
    resumed.load_state_dict(torch.load(tmp_path / "targets.pt", weights_only=True))
    expected = targets(losses, y)
    assert torch.equal(resumed(losses, y), expected)
    assert not torch.equal(NewtonTargets(**settings)(losses, y), expected)
    for one in (targets, resumed):
        one(losses, y)
    assert torch.equal(targets(of_scales(scales, scales), y), resumed(of_scales(scales, scales), y))


def test_the_state_of_targets_is_its_own_and_is_checked() -> None:
    losses, y = of_scales(scales := torch.logspace(0, 1.5, 20), scales), torch.zeros(2, 20)
    targets, other = NewtonTargets(), NewtonTargets()
    state = targets.state_dict()
    other.load_state_dict(state)  # before the first call
    targets(losses, y)
    expected, state = targets(losses, y), targets.state_dict()
    other.load_state_dict(state)
    state["factor"].zero_()
    assert torch.equal(other(losses, y), expected)
    good = other.state_dict()
    for wrong, error, message in (
        ([], TypeError, "state must be a state_dict of NewtonTargets, got list"),
        ({"wait": 0}, KeyError, "state must be a state_dict of NewtonTargets, this one lacks factor"),
        (good | {"factor": 3.0}, TypeError, "factor must be a tensor, got float"),
        (good | {"factor": torch.ones(2, 3)}, ValueError, r"factor must be a matrix \[n, n\], got \[2, 3\]"),
        (good | {"wait": -1}, ValueError, "wait must be at least 0, got -1"),
        (good | {"factor": None, "wait": 0.5}, TypeError, "wait must be an integer, got 0.5"),
    ):
        with pytest.raises(error, match=message):
            other.load_state_dict(wrong)
        assert torch.equal(other(losses, y), expected)


class Spoiled(Counted):
    """The same, whose gradients are not finite from a pass on."""

    last = 0

    @staticmethod
    def backward(ctx, g):
        Counted.passes += 1
        return g if Counted.passes <= Spoiled.last else g * torch.nan


def test_a_later_product_that_is_not_finite_is_an_error() -> None:
    losses, y = of_scales(scales := torch.logspace(0, 1.5, 20), scales.flip(0)), torch.zeros(2, 20)
    Counted.passes = 0
    NewtonTargets()(lambda y: losses(Counted.apply(y)), y)
    Spoiled.last, Counted.passes = Counted.passes - 1, 0
    with pytest.raises(ValueError, match="the gradient or the curvature of the losses is not finite"):
        NewtonTargets()(lambda y: losses(Spoiled.apply(y)), y)
