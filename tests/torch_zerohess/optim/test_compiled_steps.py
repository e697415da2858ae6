"""A whole training step that is compiled makes the steps that it makes without `torch.compile`."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.linalg.jacobians import Rows
from torch_zerohess.optim.outside import check_inside

STEPS = {
    "NewtonCG": lambda params: zh.optim.NewtonCG(params, radius=0.3),
    "gauss_newton": lambda params: zh.optim.NewtonCG(params, radius=0.3, curvature="gauss_newton"),
    "Newton": lambda params: zh.optim.Newton(params, radius=0.3),
    "NonlinearCG": lambda params: zh.optim.NonlinearCG(params, radius=0.3),
}


Train = Callable[[torch.nn.Module, zh.BlackBox, Tensor], Callable[[], Tensor]]


def losses(compiled: bool, train: Train) -> list[float]:
    torch.compiler.reset()
    torch.manual_seed(0)
    network, x = torch.nn.Linear(4, 3), torch.randn(6, 4)
    layer = zh.BlackBox(lambda z: z.square().square().sum(1), zh.Smoothing(sigma=0.4, samples=8, seed=3))
    step = train(network, layer, x)
    if compiled:
        step = torch.compile(step, backend="aot_eager")
    return [float(step()) for _ in range(4)]


@pytest.mark.parametrize("make", STEPS.values(), ids=STEPS.keys())
def test_a_compiled_step_of_an_optimizer(make: Callable[..., torch.optim.Optimizer]) -> None:
    def train(network: torch.nn.Module, layer: zh.BlackBox, x: Tensor) -> Callable[[], Tensor]:
        optimizer = make(network.parameters())
        return lambda: optimizer.step(lambda: layer(network(x)).mean())

    assert losses(True, train) == losses(False, train)


def test_a_compiled_step_to_targets() -> None:
    def train(network: torch.nn.Module, layer: zh.BlackBox, x: Tensor) -> Callable[[], Tensor]:
        targets = zh.optim.NewtonTargets()

        def step() -> Tensor:
            y = network(x).detach()
            zh.optim.move_outputs(network, x, targets(layer, y) - y)
            return targets.losses.mean()

        return step

    assert losses(True, train) == losses(False, train)


def test_a_compiled_network_whose_second_backward_pass_is_wrong_is_named() -> None:
    """With dynamic shapes torch 2.15 gets other gradients from the second pass; a Jacobian of zeros stands for them."""
    torch.compiler.reset()
    network = torch.nn.Linear(4, 3)
    layer = zh.BlackBox(lambda z: z.square().sum(1), zh.Smoothing(sigma=0.4, samples=8))
    loss = layer(torch.compile(network, backend="aot_eager")(torch.randn(6, 4))).mean()
    operator = zh.CurvatureOperator(loss, network.parameters(), mode="gauss_newton")
    wrong = Rows(torch.zeros(18, 15))
    with pytest.raises(RuntimeError, match=r"outside of torch\.compile, got one with a compiled backward"):
        check_inside(wrong, [operator], operator.gradient.double(), sampled=False)
