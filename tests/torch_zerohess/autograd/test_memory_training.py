"""Training through a memory whose surrogate knows nothing ends as well as training without a memory."""

import math

import pytest
import torch
from torch import Tensor, nn

import torch_zerohess as zh

FREQUENCIES = torch.tensor([[1.0, 0.4], [-0.3, 1.2], [0.7, 0.9]])  # [m, n]
SEEDS, STEPS, BATCH = 3, 40, 16
SIZE = 0.1
"""First step size: learning rate of Adam, trust radius of Newton."""


def render(z: Tensor) -> Tensor:
    """Images [K, 3] of parameters [K, 2]."""
    return torch.sin(z @ FREQUENCIES.mT)


class Untrained(nn.Module):
    """A random network whose outputs are about twenty times as large as the images."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        generator = torch.Generator().manual_seed(seed)
        self.weights = [torch.randn(*shape, generator=generator) for shape in ((2, 16), (16, 3))]

    def forward(self, z: Tensor) -> Tensor:
        first, second = self.weights
        return 5.0 * torch.tanh(z @ first) @ second


def error_after(optimizer: str, seed: int, memory: zh.Memory | None) -> tuple[float, float]:
    """Train a linear network near its solution; return the mean errors of held-out images before and after."""
    torch.manual_seed(seed)
    solution, network = nn.Linear(4, 2), nn.Linear(4, 2)
    inputs, held_out = torch.randn(2, 64, 4)
    with torch.no_grad():
        for weights, others in zip(network.parameters(), solution.parameters(), strict=True):
            weights.copy_(others + 0.3 * torch.randn_like(others))
        references, sought = render(solution(inputs)), render(solution(held_out))
    smoothing = zh.Smoothing(sigma=0.2, samples=4, baseline="none")
    layer = zh.BlackBox(render, smoothing, head=zh.heads.SquaredError(), memory=memory, value="smoothed")
    adam = torch.optim.Adam(network.parameters())
    step = {"solver": "dual", "modification": "abs", "damping": 1e-3, "adapt": False}
    newton = zh.optim.NewtonCG(network.parameters(), radius=SIZE, curvature="gauss_newton", **step)

    def error() -> float:
        with torch.no_grad():
            return float((render(network(held_out)) - sought).square().mean())

    before = error()
    for number in range(STEPS):
        part = torch.arange(BATCH * number, BATCH * (number + 1)) % len(inputs)
        adam.param_groups[0]["lr"] = newton.param_groups[0]["radius"] = SIZE * 0.02 ** (number / STEPS)

        def loss(part: Tensor = part) -> Tensor:
            return layer(network(inputs[part]), references[part]).mean()

        if optimizer == "newton":
            newton.step(loss)
        else:
            adam.zero_grad()
            loss().backward()
            adam.step()
    return before, error()


@pytest.mark.parametrize("optimizer", ["adam", "newton"])
def test_an_untrained_network_as_surrogate_leaves_the_final_error_as_it_is(optimizer: str) -> None:
    """The mean of log(error with it / error without it) over seeds is zero within its noise.

    One such logarithm has a standard deviation of 0.2 (Adam) and 0.3 (Newton), the mean of three of 0.17 at most. Both
    methods divide the error by more than ten. With a coefficient of 1 the mean is 3 and more.
    """
    logarithms = []
    for seed in range(SEEDS):
        before, without = error_after(optimizer, seed, None)
        same, with_memory = error_after(optimizer, seed, zh.Memory(Untrained(100 + seed)))
        assert same == before
        logarithms.append((math.log(without / before), math.log(with_memory / without)))
    gain, change = (sum(one) / SEEDS for one in zip(*logarithms, strict=True))
    assert gain < -math.log(10.0)
    assert abs(change) < 0.65
