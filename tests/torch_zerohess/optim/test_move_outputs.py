"""The step on the weights that moves outputs, against dense least squares."""

import copy

import pytest
import torch
from torch import Tensor, nn

import torch_zerohess as zh


def made() -> tuple[nn.Module, Tensor, Tensor]:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(4, 6), nn.Tanh(), nn.Linear(6, 2)).double()
    return network, torch.randn(3, 4).double(), torch.randn(3, 2).double()


def weights(network: nn.Module) -> Tensor:
    return torch.cat([one.detach().flatten() for one in network.parameters() if one.requires_grad])


@pytest.mark.parametrize("damping", [1e-6, 0.3, 10.0])
def test_the_step_is_the_least_squares_solution(damping: float) -> None:
    network, x, change = made()
    parameters = list(network.parameters())
    rows = [torch.autograd.grad(y, parameters, retain_graph=True) for y in network(x).flatten()]
    J = torch.stack([torch.cat([one.flatten() for one in row]) for row in rows])
    h = J.square().sum(1).mean()
    # The normal equations of all weights, where the library solves those of all outputs.
    expected = torch.linalg.solve(J.T @ J + damping * h * torch.eye(J.shape[1]).double(), J.T @ change.flatten())
    before = weights(network)
    zh.optim.move_outputs(network, x, change, relative_damping=damping)
    torch.testing.assert_close(weights(network) - before, expected, rtol=1e-8, atol=1e-10)


def test_the_scale_of_the_weights_does_not_matter() -> None:
    """The same function: a last layer with a hundredth of the weights, and a factor of a hundred after it."""
    network, x, change = made()
    network[0].requires_grad_(False)
    small = copy.deepcopy(network)
    with torch.no_grad():
        for one in small[2].parameters():
            one.mul_(0.01)
    scaled = nn.Sequential(small, nn.Linear(2, 2, bias=False).double().requires_grad_(False))
    scaled[1].weight.copy_(100.0 * torch.eye(2))
    for one in (network, scaled):
        zh.optim.move_outputs(one, x, change)
    torch.testing.assert_close(scaled(x), network(x))


def test_parameters_that_do_not_require_grad_stay() -> None:
    network, x, change = made()
    network[0].requires_grad_(False)
    before = network[0].weight.clone()
    zh.optim.move_outputs(network, x, change)
    assert torch.equal(network[0].weight, before)
    assert all(one.grad is None for one in network.parameters())


def test_what_cannot_be_moved_is_said() -> None:
    network, x, change = made()
    before = weights(network)
    with pytest.raises(ValueError, match=r"change must be \[3, 2\], one for each output, got \[2, 3\]"):
        zh.optim.move_outputs(network, x, change.mT)
    with pytest.raises(ValueError, match="change must be finite"):
        zh.optim.move_outputs(network, x, change / 0.0)
    with pytest.raises(ValueError, match="inputs must be at least one, got none"):
        zh.optim.move_outputs(network, x[:0], change[:0])
    with pytest.raises(ValueError, match="the Jacobian of the network is not finite"):
        zh.optim.move_outputs(network, x * torch.nan, change)
    with pytest.raises(ValueError, match="damping must be positive, got 0"):
        zh.optim.move_outputs(network, x, change, relative_damping=0.0)
    with pytest.raises(ValueError, match="outputs of the network do not change with its weights"):
        zh.optim.move_outputs(nn.Sequential(nn.Linear(4, 2), nn.Hardtanh()), 1e9 * torch.ones(1, 4), torch.ones(1, 2))
    assert torch.equal(weights(network), before)
    with pytest.raises(ValueError, match="network must have weights that require grad, got none"):
        zh.optim.move_outputs(network.requires_grad_(False), x, change)


class Counted(nn.Module):
    """Outputs over a running mean of the inputs, which a forward pass in training mode changes."""

    def __init__(self, *, in_place: bool) -> None:
        super().__init__()
        self.layer, self.in_place = nn.Linear(4, 2), in_place
        self.mean: Tensor
        self.register_buffer("mean", torch.ones(4))

    def forward(self, x: Tensor) -> Tensor:
        y = self.layer(x / self.mean.detach().clone())
        mean = 0.9 * self.mean + 0.1 * x.detach().mean(0)
        if self.in_place:
            self.mean.copy_(mean)
        else:
            self.mean = mean
        return y


@pytest.mark.parametrize("in_place", [False, True])
def test_buffers_stay_as_they_are(*, in_place: bool) -> None:
    _, x, change = made()
    network = Counted(in_place=in_place).double()
    before = copy.deepcopy(network)(x).detach()
    zh.optim.move_outputs(network, x, change, relative_damping=1e-9)
    assert torch.equal(network.mean, torch.ones(4).double())
    torch.testing.assert_close(copy.deepcopy(network)(x) - before, change, rtol=0, atol=1e-4)


class Centered(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(4, 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.layer(x - x.mean(0))


def test_a_network_that_mixes_samples_is_refused() -> None:
    network, (_, x, change) = Centered().double(), made()
    with pytest.raises(ValueError, match="it mixes samples"):
        zh.optim.move_outputs(network, x, change)


def test_the_step_is_the_same_under_autocast() -> None:
    network, x, change = made()
    network, x, change = network.float(), x.float(), change.float()
    other = copy.deepcopy(network)
    zh.optim.move_outputs(network, x, change)
    with torch.autocast("cpu", torch.bfloat16):
        zh.optim.move_outputs(other, x, change)
        assert torch.equal(weights(network), weights(other))
        zh.optim.move_outputs(other, x.bfloat16(), change)  # as another network under autocast makes them


def test_a_network_in_which_one_module_stands_twice_keeps_its_buffers() -> None:
    norm = nn.BatchNorm1d(4)
    network = nn.Sequential(norm, nn.Linear(4, 4), norm, nn.Linear(4, 2)).double().eval()
    before = norm.running_mean
    _, x, change = made()
    zh.optim.move_outputs(network, x, change)
    assert norm.running_mean is before
    copy.deepcopy(network)


def test_matrix_products_of_lower_precision_mix_no_samples() -> None:
    torch.manual_seed(0)
    network = nn.Sequential(nn.Linear(64, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 4))
    x, change = torch.randn(64, 64), 0.01 * torch.randn(64, 4)
    before, precision = network(x).detach(), torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("medium")
    try:
        zh.optim.move_outputs(network, x, change)
    finally:
        torch.set_float32_matmul_precision(precision)
    assert float((network(x).detach() - before - change).norm()) < 0.5 * float(change.norm())  # a damped step
