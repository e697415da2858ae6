"""Curvature of a compiled model: torch does not differentiate a compiled backward again, so it is an error."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn

import torch_zerohess as zh

pytestmark = [
    pytest.mark.usefixtures("fresh_compiler", "quick_inductor"),
    pytest.mark.filterwarnings("ignore:The .grad attribute of a Tensor that is not a leaf"),  # dynamo looks at it
]

COMPILED = "outside of torch.compile"


def fourth_power(z: Tensor) -> Tensor:
    return z.square().square().sum(1)


def quartic() -> zh.BlackBox:
    return zh.BlackBox(fourth_power, zh.Smoothing(sigma=0.4, samples=8, seed=3))


def model() -> tuple[nn.Module, Tensor]:
    torch.manual_seed(0)
    return nn.Linear(4, 3), torch.randn(6, 4)


@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
@pytest.mark.parametrize("last", [quartic(), fourth_power], ids=["layer", "torch"])
def test_curvature_of_a_compiled_loss_is_an_error(last: Callable[[Tensor], Tensor], backend: str) -> None:
    network, x = model()
    weights = list(network.parameters())

    def loss() -> Tensor:
        return last(network(x)).mean()

    v = [torch.ones_like(one) for one in weights]
    assert all(bool(one.any()) for one in zh.hvp(loss(), weights, v))
    with pytest.raises(RuntimeError, match=COMPILED):
        zh.hvp(torch.compile(loss, backend=backend)(), weights, v)


def test_curvature_of_a_loss_of_a_compiled_network_is_an_error() -> None:
    network, x = model()
    weights = list(network.parameters())
    y = torch.compile(network, backend="aot_eager")(x)
    v = [torch.ones_like(one) for one in weights]
    for mode in ("exact", "gauss_newton"):
        with pytest.raises(RuntimeError, match=COMPILED):
            zh.hvp(quartic()(y).mean(), weights, v, mode=mode)


@pytest.mark.parametrize("solver", ["steihaug", "dual"])
def test_curvature_of_a_compiled_loss_behind_a_network_is_an_error(solver: str) -> None:
    network, x = model()
    optimizer = zh.optim.NewtonCG(network.parameters(), curvature="gauss_newton", solver=solver, damping=1e-3)

    def closure() -> tuple[Tensor, Tensor]:
        y = network(x)
        return torch.compile(lambda y: fourth_power(y).mean(), backend="aot_eager")(y), y

    with pytest.raises(RuntimeError, match=COMPILED):
        optimizer.step(closure)


def test_memory_that_a_compiled_backward_uses_again_is_an_error() -> None:
    network = nn.Sequential(nn.Linear(4, 8), nn.Tanh(), nn.Linear(8, 3))
    compiled, x = torch.compile(network, backend="aot_eager"), torch.ones(6, 4)
    compiled(x).sum().backward()  # the backward that is compiled now keeps no graph
    y = compiled(x)
    with pytest.raises(RuntimeError, match=COMPILED):
        zh.CurvatureOperator(quartic()(y).mean(), list(network.parameters()), mode="gauss_newton")


def test_targets_of_compiled_losses_are_an_error() -> None:
    scale, y = torch.tensor([1.0, 100.0]), torch.ones(3, 2)
    losses = torch.compile(lambda y: fourth_power(scale * nn.functional.softplus(y)), backend="aot_eager")
    with pytest.raises(RuntimeError, match=COMPILED):
        zh.optim.NewtonTargets()(losses, y)


def test_what_is_compiled_beside_the_path_to_the_parameters_does_no_harm() -> None:
    network, x = model()
    other = nn.Linear(4, 1)
    added = torch.compile(other, backend="aot_eager")(x).mean()
    weights = list(network.parameters())
    v = [torch.ones_like(one) for one in weights]
    alone = fourth_power(network(x)).mean()
    for mode in ("exact", "gauss_newton"):
        through = None if mode == "exact" else network(x)
        loss = alone if through is None else fourth_power(through).mean()
        expected = zh.hvp(loss, weights, v, mode=mode, through=through)
        assert all(map(torch.equal, zh.hvp(loss + added, weights, v, mode=mode, through=through), expected))


def test_a_compiled_network_has_first_derivatives_for_products_of_the_caller() -> None:
    ends = []
    for compiled in (False, True):
        network, x = model()
        called = torch.compile(network, backend="aot_eager") if compiled else network
        optimizer = zh.optim.NonlinearCG(network.parameters(), radius=0.1, line_search_iterations=1)
        optimizer.step(lambda called=called, x=x: called(x).square().mean(), hvp=lambda v: 2.0 * v)
        ends.append(network.weight.detach().clone())
    torch.testing.assert_close(*ends)


def test_a_compiled_network_before_samples_of_its_jacobian() -> None:
    ends = []
    for compiled in (False, True):
        network, x = model()
        called = torch.compile(network, backend="aot_eager") if compiled else network
        optimizer = zh.optim.NewtonCG(
            network.parameters(), radius=0.1, curvature="gauss_newton", solver="dual", damping=1e-3, adapt=False
        )

        def closure(
            called: nn.Module = called, network: nn.Module = network, x: Tensor = x
        ) -> tuple[Tensor, Tensor, zh.optim.SampleJacobian]:
            y = called(x)
            return fourth_power(y).mean(), y, zh.optim.SampleJacobian(network, x)

        optimizer.step(closure)
        ends.append(network.weight.detach().clone())
    torch.testing.assert_close(*ends)


def test_products_in_compiled_code_take_the_graph_that_was_made_outside() -> None:
    network, x = model()
    weights = list(network.parameters())
    v = [torch.ones_like(one) for one in weights]
    loss = quartic()(network(x)).mean()

    def products() -> tuple[list[Tensor], Tensor]:
        operator = zh.CurvatureOperator(loss, weights)
        return zh.hvp(loss, weights, v), operator @ torch.ones(operator.shape[0])

    (parts, whole), expected = torch.compile(products, backend="aot_eager")(), products()
    assert all(map(torch.equal, parts, expected[0]))
    assert torch.equal(whole, expected[1])
