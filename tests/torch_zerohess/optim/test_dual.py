"""Solvers of NewtonCG behind a network against dense truth: dual, clipped, and the magnitudes of curvature."""

import pytest
import torch
from torch import Tensor, nn

import torch_zerohess as zh
from torch_zerohess.autograd.blocks import jacobian, output_blocks
from torch_zerohess.autograd.curvature import CurvatureOperator
from torch_zerohess.autograd.sample_jacobian import SampleJacobian
from torch_zerohess.linalg.dual import dual_step
from torch_zerohess.linalg.jacobians import Rows
from torch_zerohess.linalg.step import Step, clipped


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(4, 6), nn.Tanh(), nn.Linear(6, 2)).double()


IMAGES = torch.randn(5, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def losses(y: Tensor) -> Tensor:
    """Indefinite in y [B, 2]: [B]."""
    return torch.sin(2.0 * y[:, 0]) + y[:, 0] * y[:, 1] - 0.3 * y[:, 1] ** 2


def dense(net: nn.Module) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """J [10, N], the modified curvature A [10, 10], its gradient g [10], and y."""
    J = SampleJacobian(net, IMAGES)(list(net.parameters()))
    y = net(IMAGES).detach()
    hessian = torch.autograd.functional.hessian(lambda z: losses(z).mean(), y)
    A = torch.zeros(10, 10, dtype=torch.float64)
    for b in range(5):
        values, vectors = torch.linalg.eigh(hessian[b, :, b])
        A[2 * b : 2 * b + 2, 2 * b : 2 * b + 2] = vectors @ values.abs().diag() @ vectors.mT
    z = y.clone().requires_grad_()
    (g,) = torch.autograd.grad(losses(z).mean(), z)
    return J, A, g.flatten(), y


@pytest.mark.parametrize("hidden", [False, True], ids=["linear", "with a hidden layer"])
@pytest.mark.parametrize("samples", [slice(4), slice(1), [*range(5), *range(5)]], ids=["4", "1", "10"])
def test_a_jacobian_of_another_batch_is_refused(samples: slice | list[int], hidden: bool) -> None:
    net = network() if hidden else nn.Linear(4, 2).double()
    layer = zh.BlackBox(lambda z: z.square(), zh.Smoothing(sigma=0.3), head=zh.heads.SquaredError())
    settings = {"curvature": "gauss_newton", "solver": "dual", "modification": "abs", "damping": 1e-3, "adapt": False}
    optimizer = zh.optim.NewtonCG(net.parameters(), radius=0.5, **settings)  # type: ignore[arg-type]

    def closure() -> tuple[Tensor, Tensor, SampleJacobian]:
        y = net(IMAGES)
        return layer(y, torch.zeros(5, 2)).mean(), y, SampleJacobian(net, IMAGES[samples])

    count = len(IMAGES[samples])
    message = rf"its Jacobian has {2 * count} rows \({count} samples\), and y has 10 numbers$"
    with pytest.raises(ValueError, match=rf"^SampleJacobian must have the inputs of the same batch: {message}"):
        optimizer.step(closure)


def flat(net: nn.Module) -> Tensor:
    return torch.cat([one.detach().flatten() for one in net.parameters()])


def stepped(net: nn.Module, solver: str, **settings: float | None) -> Tensor:
    """The step [N] of NewtonCG on the losses of the images, with magnitudes of eigenvalues."""
    optimizer = zh.optim.NewtonCG(
        net.parameters(),
        curvature="gauss_newton",
        solver=solver.split()[0],
        modification="abs",
        iterations=500,
        tolerance=1e-13,
        adapt=False,
        **settings,  # type: ignore[arg-type]
    )
    before = flat(net)
    images = IMAGES.to(before.dtype)

    def closure() -> object:
        y = net(images)
        loss = losses(y).mean()
        return (loss, y, SampleJacobian(net, images)) if "Jacobian" in solver else (loss, y)

    optimizer.step(closure)  # type: ignore[arg-type]
    return flat(net) - before


@pytest.mark.parametrize("solver", ["dual", "clip", "dual with a Jacobian"])
@pytest.mark.parametrize("radius", [1e6, 0.05])
def test_steps_equal_the_dense_solution(solver: str, radius: float) -> None:
    net, damping = network(), 1e-2
    J, A, g, _ = dense(net)
    H = J.mT @ A @ J + damping * torch.eye(J.shape[1], dtype=torch.float64)
    expected = -torch.linalg.solve(H, J.mT @ g)
    expected = expected * min(1.0, radius / float(expected.norm()))
    torch.testing.assert_close(stepped(net, solver, radius=radius, damping=damping), expected, rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("solver", ["dual", "dual with a Jacobian", "clip", "steihaug"])
def test_no_element_of_the_outputs_moves_beyond_the_output_radius(solver: str) -> None:
    free = stepped(network(), solver, radius=1e6, damping=1e-2)
    J, *_ = dense(network())
    farthest = float((J @ free).view(5, 2).norm(dim=1).max())
    for output_radius in (0.5 * farthest, 2.0 * farthest, None):
        step = stepped(network(), solver, radius=1e6, damping=1e-2, output_radius=output_radius)
        factor = 0.5 if output_radius == 0.5 * farthest else 1.0
        torch.testing.assert_close(step, factor * free, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("solver", ["dual", "dual with a Jacobian", "clip", "steihaug"])
def test_weights_of_single_precision_have_an_output_radius(solver: str) -> None:
    settings = {"radius": 1e6, "damping": 1e-2, "output_radius": 0.01}
    step = stepped(network().float(), solver, **settings)
    torch.testing.assert_close(step, stepped(network(), solver, **settings).float(), rtol=1e-3, atol=1e-6)
    J, *_ = dense(network())
    assert float((J @ step.double()).view(5, 2).norm(dim=1).max()) == pytest.approx(0.01, rel=1e-3)


def test_jacobians_agree() -> None:
    net = network()
    y = net(IMAGES)
    operator = CurvatureOperator(losses(y).mean(), list(net.parameters()), mode="gauss_newton", through=y)
    torch.testing.assert_close(jacobian(operator), SampleJacobian(net, IMAGES)(list(net.parameters())))
    with pytest.raises(ValueError, match="parameters of the network"):
        SampleJacobian(net, IMAGES)([torch.zeros(3)])


@pytest.mark.parametrize("layer", [torch.nn.BatchNorm1d(4), torch.nn.Dropout(0.5)])
def test_a_jacobian_per_sample_is_of_evaluation_mode(layer: torch.nn.Module) -> None:
    net = torch.nn.Sequential(torch.nn.Linear(3, 4), layer)
    with pytest.raises(ValueError, match=rf"a {type(layer).__name__} in training mode \('1'\).*net.*eval\(\) first"):
        SampleJacobian(net, torch.ones(6, 3))(list(net.parameters()))
    net.eval()
    assert SampleJacobian(net, torch.ones(6, 3))([net[0].weight]).shape == (24, 12)


COUPLED = {
    "all elements": lambda a, b: a.sum() ** 2 + b.square().sum(),
    "two elements": lambda a, b: a.square().sum() + b.square().sum() + 3.0 * (a[0] * a[2]).sum(),
    "elements of the second tensor": lambda a, b: a.square().sum() + b.sum(0).square().sum(),
    "elements of two tensors": lambda a, b: a.square().sum() + b.square().sum() + (a[1] * b[1]).sum(),
}


@pytest.mark.parametrize("loss", COUPLED.values(), ids=COUPLED.keys())
def test_coupled_elements_are_refused(loss) -> None:
    net = network()
    a, b = net(IMAGES), net(2.0 * IMAGES)
    operator = CurvatureOperator(loss(a, b), list(net.parameters()), mode="gauss_newton", through=[a, b])
    with pytest.raises(ValueError, match="couples its elements"):
        output_blocks(operator)


@pytest.mark.parametrize("batch", [(5,), (2, 3)])
def test_curvature_of_rounding_couples_no_elements(batch) -> None:
    """Second derivatives of locally linear losses are zero but for rounding, which is not symmetric."""
    y = torch.zeros(*batch, 2, dtype=torch.float64, requires_grad=True)

    class Rounded(torch.autograd.Function):
        @staticmethod
        def forward(ctx, z: Tensor) -> Tensor:
            return torch.ones_like(z)

        @staticmethod
        def backward(ctx, gradient: Tensor) -> Tensor:
            return 1e-19 * torch.stack([0.3 * gradient[..., 1], -0.2 * gradient[..., 0] + gradient[..., 1]], -1)

    class Slopes(torch.autograd.Function):
        @staticmethod
        def forward(ctx, z: Tensor) -> Tensor:
            ctx.save_for_backward(z)
            return z.sum()

        @staticmethod
        def backward(ctx, gradient: Tensor) -> Tensor:
            return gradient * Rounded.apply(*ctx.saved_tensors)

    operator = CurvatureOperator(Slopes.apply(y), y, mode="gauss_newton", through=y)
    assert output_blocks(operator)[0].abs().max() < 1e-18


@pytest.mark.parametrize("pair", [(0, 1), (0, 2), (1, 5), (4, 0)])
def test_two_coupled_elements_are_refused(pair) -> None:
    y = torch.randn(6, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64).requires_grad_()
    loss = y.square().sum() + y[pair[0], 0] * y[pair[1], 1]
    with pytest.raises(ValueError, match="couples its elements"):
        output_blocks(CurvatureOperator(loss, y, mode="gauss_newton", through=y))


@pytest.mark.parametrize("n", [2, 100])
def test_elements_in_half_precision_are_not_coupled_by_rounding(n: int) -> None:
    y = torch.randn(6, n, generator=torch.Generator().manual_seed(0)).bfloat16().requires_grad_()

    def blocks(loss: Tensor) -> Tensor:
        return output_blocks(CurvatureOperator(loss, y, mode="gauss_newton", through=y))[0]

    losses_of = (y[:, 1] - y[:, 0].square()).square() + (1 - y[:, 0]).square()
    hessian = torch.func.vmap(torch.func.hessian(lambda z: (z[1] - z[0] ** 2) ** 2 + (1 - z[0]) ** 2))
    exact = hessian(y.detach().double())
    rounding = torch.finfo(y.dtype).eps * float(exact.abs().max())
    torch.testing.assert_close(blocks(losses_of.sum()), exact, rtol=0.0, atol=4.0 * rounding)
    with pytest.raises(ValueError, match="couples its elements"):
        blocks(y.square().mean().square())


@pytest.mark.parametrize("solver", ["dual", "clip"])
def test_indefinite_curvature_is_descended(solver) -> None:
    """On -|y|^2, which no step makes positive, a Newton step would go to the maximum."""
    x = torch.tensor([[0.5, 1.0], [-1.0, 0.2]], dtype=torch.float64, requires_grad=True)
    optimizer = zh.optim.NewtonCG([x], curvature="gauss_newton", solver=solver, damping=1e-3, adapt=False, radius=1.0)
    seen = []
    for _ in range(3):
        y = 1.0 * x
        seen.append(float(optimizer.step(lambda y=y: (-y.square().sum(), y)).detach()))
    assert seen[0] > seen[1] > seen[2]


def test_the_input_of_the_black_box_may_be_a_permuted_view() -> None:
    layer = zh.BlackBox(lambda z: (z - 1.0).square().sum(1), zh.Smoothing(sigma=0.1, samples=32, seed=0))
    images = torch.randn(2, 1, 5, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ends = []
    for copied in (True, False):
        torch.manual_seed(0)
        weights = nn.Conv2d(1, 3, 3).double()

        def loss(copied=copied, weights=weights) -> Tensor:
            y = weights(images).permute(0, 2, 3, 1)
            return layer(y.contiguous() if copied else y).mean()

        settings = {"curvature": "gauss_newton", "solver": "dual", "damping": 0.01, "adapt": False}
        zh.optim.NewtonCG(weights.parameters(), radius=1.0, **settings).step(loss)
        ends.append(torch.cat([one.detach().flatten() for one in weights.parameters()]))
    torch.testing.assert_close(*ends)


def test_a_gradient_from_elsewhere_is_refused() -> None:
    net = network()
    optimizer = zh.optim.NewtonCG(net.parameters(), curvature="gauss_newton", solver="dual", damping=1e-2, adapt=False)

    def closure() -> tuple[Tensor, Tensor]:
        y = net(IMAGES)
        return losses(y).square().mean() + flat_norm(net), y

    with pytest.raises(ValueError, match=r"inputs of black boxes alone.* penalty of the weights: use solver"):
        optimizer.step(closure)


@pytest.mark.parametrize("sampled", [False, True], ids=["by rows", "SampleJacobian"])
def test_a_network_in_half_precision_is_refused_for_its_precision_alone(sampled) -> None:
    net = network().float()
    optimizer = zh.optim.NewtonCG(net.parameters(), curvature="gauss_newton", solver="dual", damping=1e-2, adapt=False)

    def closure():
        with torch.autocast("cpu", torch.bfloat16):
            y = net(IMAGES.float()).float()
        jacobian = (SampleJacobian(net, IMAGES.float()),) if sampled else ()
        return losses(y).square().mean(), y, *jacobian

    with pytest.raises(ValueError, match=r"^solver 'dual' needs a network in single or double precision, got") as error:
        optimizer.step(closure)
    assert "torch.autocast" in str(error.value)
    assert "black boxes alone" not in str(error.value)


def test_samples_in_another_order_are_refused_for_their_order_alone() -> None:
    net = network()
    optimizer = zh.optim.NewtonCG(net.parameters(), curvature="gauss_newton", solver="dual", damping=1e-2, adapt=False)

    def closure() -> tuple[Tensor, Tensor, SampleJacobian]:
        y = net(IMAGES)
        return losses(y).square().mean(), y, SampleJacobian(net, IMAGES.flip(0))

    with pytest.raises(ValueError, match=r"^solver 'dual' needs a SampleJacobian of the batch.* another order$"):
        optimizer.step(closure)


def flat_norm(net: nn.Module) -> Tensor:
    return torch.stack([one.square().sum() for one in net.parameters()]).sum()


def test_the_decrease_is_the_decrease_of_the_model() -> None:
    J, A, g, _ = dense(network())
    for radius in (0.05, 1e6):
        step = dual_step(Rows(J), A, g, radius, 1e-3)
        moved = J @ step.s
        assert step.decrease == pytest.approx(-float(g @ moved + 0.5 * moved @ A @ moved))
        assert float(step.s.norm()) <= radius * (1 + 1e-12)
    H, gradient = J.mT @ A @ J, J.mT @ g
    s = -gradient
    whole = Step(s, -float(gradient @ s + 0.5 * s @ H @ s), "converged")
    short = clipped(whole, gradient, 0.1)
    expected = -float(gradient @ short.s + 0.5 * short.s @ H @ short.s)
    assert short.decrease == pytest.approx(expected)
    assert float(short.s.norm()) == pytest.approx(0.1)


def decrease_and_step(solver: str, radius: float) -> tuple[float, Tensor]:
    net, found = network(), []
    optimizer = zh.optim.NewtonCG(
        net.parameters(),
        curvature="gauss_newton",
        solver=solver,
        modification="abs",
        damping=0.1,
        radius=radius,
        iterations=500,
        tolerance=1e-13,
        adapt=False,
    )
    inner = optimizer._minimise
    optimizer._minimise = lambda *given: found.append(inner(*given)) or found[-1]  # type: ignore[method-assign]

    def closure() -> tuple[Tensor, Tensor]:
        y = net(IMAGES)
        return losses(y).mean(), y

    optimizer.step(closure)
    return found[0].decrease, found[0].s


@pytest.mark.parametrize("radius", [1e6, 0.05])
def test_solvers_promise_the_same_decrease_for_the_same_step(radius) -> None:
    """The decrease of the loss: damping is no part of it."""
    (dual, s), (clip, other) = decrease_and_step("dual", radius), decrease_and_step("clip", radius)
    torch.testing.assert_close(s, other, rtol=1e-5, atol=1e-8)
    assert clip == pytest.approx(dual, rel=1e-5)


def test_losses_of_elements_are_one_operator_for_the_dual_solver() -> None:
    net, operators = network(), []
    optimizer = zh.optim.NewtonCG(net.parameters(), curvature="gauss_newton", solver="dual", damping=1e-2, adapt=False)
    optimizer._minimise = lambda model, *rest: (
        operators.append(len(model._operators))
        or Step(  # type: ignore
            torch.zeros_like(model.gradient), 0.0, "converged"
        )
    )

    def closure() -> tuple[Tensor, Tensor]:
        y = net(IMAGES)
        return losses(y), y

    optimizer.step(closure)
    assert operators == [1]


def test_a_jacobian_of_another_kind_is_refused() -> None:
    net = network()
    optimizer = zh.optim.NewtonCG(net.parameters(), curvature="gauss_newton", solver="dual", damping=1e-2, adapt=False)
    y = net(IMAGES)
    with pytest.raises(TypeError, match="closure must return a SampleJacobian after the loss and y, got Tensor"):
        optimizer.step(lambda: (losses(y).mean(), y, torch.ones(10, 44)))  # type: ignore[arg-type, return-value]


def test_wrong_settings_say_so() -> None:
    net = network()
    for message, settings in (
        ("solver must be one of", {"solver": "cg"}),
        ("modification must be None or 'abs'", {"modification": "shift"}),
        ("needs curvature 'gauss_newton'", {"solver": "dual", "damping": 1.0}),
        ("needs curvature 'gauss_newton'", {"modification": "abs"}),
        ("needs a positive damping", {"solver": "dual", "curvature": "gauss_newton"}),
        ("output_radius needs curvature 'gauss_newton'", {"output_radius": 1.0}),
        ("output_radius must be positive, got 0", {"output_radius": 0.0, "curvature": "gauss_newton"}),
    ):
        with pytest.raises(ValueError, match=message):
            zh.optim.NewtonCG(net.parameters(), **settings)  # type: ignore[arg-type]
    with pytest.raises(
        ValueError, match="params must have no settings of their own, got solver: give them to NewtonCG"
    ):
        zh.optim.NewtonCG([{"params": list(net.parameters()), "solver": "stehaug"}])  # type: ignore[list-item]
    with pytest.raises(TypeError, match="adapt must be True or False, got 'no'"):
        zh.optim.Newton(net.parameters(), adapt="no")  # type: ignore[arg-type]


@pytest.mark.parametrize("solver", ["steihaug", "clip", "dual"])
@pytest.mark.parametrize("adapt", [True, False])
@pytest.mark.parametrize("output_radius", [None, 0.05])
def test_single_precision_takes_the_steps_of_double(solver: str, adapt: bool, output_radius: float | None) -> None:
    found = []
    for dtype in (torch.float32, torch.float64):
        net, images = network().to(dtype), IMAGES.to(dtype)
        optimizer = zh.optim.NewtonCG(
            net.parameters(),
            curvature="gauss_newton",
            solver=solver,
            damping=1e-2,
            adapt=adapt,
            output_radius=output_radius,
        )

        def closure(net: nn.Module = net, images: Tensor = images) -> tuple[Tensor, Tensor]:
            y = net(images)
            return y.square().mean(), y

        found.append([float(optimizer.step(closure)) for _ in range(3)])  # type: ignore[arg-type]
    assert all(one[2] < one[1] < one[0] for one in found)
    assert found[0] == pytest.approx(found[1], rel=1e-3, abs=1e-4 * found[1][0])  # as rounding of the first step
