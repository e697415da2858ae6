"""Jacobians per sample and their products, against one backward pass for every output."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import register_parametrization

from torch_zerohess.autograd.sample_jacobian import SampleJacobian
from torch_zerohess.linalg.jacobians import Blocks, OuterProducts, Rows
from torch_zerohess.optim import move_outputs

SAMPLES = torch.randn(5, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


class Net(nn.Module):
    """A network whose forward function is given."""

    def __init__(self, forward: Callable[..., Tensor], **parts: nn.Module) -> None:
        super().__init__()
        self._forward = forward
        for name, part in parts.items():
            self.add_module(name, part)

    def forward(self, x: Tensor) -> Tensor:
        return self._forward(self, x)


class Factor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.factor = nn.Parameter(torch.tensor(1.5))

    def forward(self, x: Tensor) -> Tensor:
        return self.factor * x


class OwnProduct(torch.autograd.Function):
    """A product whose derivative is its own: half of the true one."""

    generate_vmap_rule = True

    @staticmethod
    def forward(x: Tensor, weight: Tensor) -> Tensor:
        return nn.functional.linear(x, weight)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.save_for_backward(*inputs)

    @staticmethod
    def backward(ctx, slope: Tensor) -> tuple[Tensor, Tensor]:
        x, weight = ctx.saved_tensors
        return 0.5 * slope @ weight, 0.5 * slope.mT @ x


def linear(p: int = 3, q: int = 4, **settings: bool) -> nn.Linear:
    return nn.Linear(q, p, **settings)


def in_rows(x: Tensor) -> Tensor:
    """Each sample as two vectors of two numbers."""
    return x.view(-1, 2, 2)


# Network, and the weights that are used as one product with a vector.
NETWORKS = {
    "two layers": lambda: (nn.Sequential(linear(6), nn.Tanh(), linear(2, 6)), {"0.weight", "2.weight"}),
    "a parameter without dimensions": lambda: (
        Net(lambda net, x: net.b(net.a(x).tanh()), a=linear(), b=Factor()),
        {"a.weight"},
    ),
    "no bias": lambda: (nn.Sequential(linear(bias=False), nn.Tanh()), {"0.weight"}),
    "a convolution before": lambda: (
        nn.Sequential(nn.Unflatten(1, (1, 4)), nn.Conv1d(1, 2, 3), nn.Tanh(), nn.Flatten(), linear(3)),
        {"4.weight"},
    ),
    "arguments by name": lambda: (
        Net(lambda net, x: nn.functional.linear(weight=net.a.weight, input=x).tanh(), a=linear(bias=False)),
        {"a.weight"},
    ),
    "a weight in two layers": lambda: (
        Net(lambda net, x: net.b(net.a(x).tanh()) + net.a(x), a=linear(4), b=linear(4)),
        {"b.weight"},
    ),
    "one layer as two": lambda: (
        (lambda one: Net(lambda net, x: net.b(net.a(x).tanh()), a=one, b=one))(linear(4)),
        set(),
    ),
    "one weight of two layers": lambda: (tied(), set()),
    "a weight used elsewhere too": lambda: (
        Net(lambda net, x: net.a(x).tanh() + net.a.weight.square().sum(), a=linear()),
        set(),
    ),
    "a product that nothing needs": lambda: (
        Net(lambda net, x: (net.a(x), x * net.a.weight.square().sum() + net.a.bias.sum())[1], a=linear()),
        set(),
    ),
    "a weight in a list": lambda: (
        Net(
            lambda net, x: net.a(x).tanh() + torch.stack([net.a.weight, net.b.weight]).sum() + net.b(x),
            a=linear(),
            b=linear(),
        ),
        set(),
    ),
    "two vectors per sample": lambda: (
        Net(lambda net, x: net.b(net.a(in_rows(x)).tanh().sum(1)), a=linear(3, 2), b=linear(2, 3)),
        {"b.weight"},
    ),
    "a derivative of its own": lambda: (
        Net(lambda net, x: OwnProduct.apply(x, net.a.weight).tanh(), a=linear(bias=False)),
        set(),
    ),
    "a weight made from another": lambda: (parametrized(), {"2.weight"}),
    "attention": lambda: (
        Net(
            lambda net, x: net.b(net.a(*(in_rows(x),) * 3)[0].flatten(1)),
            a=nn.MultiheadAttention(2, 1, batch_first=True),
            b=linear(2),
        ),
        {"b.weight"},
    ),
    "a hook that changes the result": lambda: (hooked(), {"0.weight"}),
}


@torch.jit.script
def scripted(x: Tensor, weight: Tensor) -> Tensor:
    return x.tanh() @ weight


def parametrized() -> nn.Module:
    net = nn.Sequential(linear(), nn.Tanh(), linear(2, 3))
    register_parametrization(net[0], "weight", nn.Tanh())
    return net


def tied() -> nn.Module:
    net = nn.Sequential(linear(4), nn.Tanh(), linear(4))
    net[2].weight = net[0].weight
    return net


def hooked() -> nn.Module:
    net = nn.Sequential(linear(), nn.Tanh())
    net[0].register_forward_hook(lambda module, given, result: 3.0 * result)
    return net


def backward(net: nn.Module, parameters: list[nn.Parameter]) -> Tensor:
    outputs = net(SAMPLES).flatten()
    rows = [torch.autograd.grad(one, parameters, retain_graph=True, materialize_grads=True) for one in outputs]
    return torch.stack([torch.cat([one.flatten() for one in row]) for row in rows])


@pytest.mark.parametrize("make", NETWORKS.values(), ids=NETWORKS.keys())
def test_rows_and_products_are_those_of_backward_passes(make) -> None:
    torch.manual_seed(0)
    net, outer = make()
    net.double().eval()
    named = dict(net.named_parameters())
    jacobian = SampleJacobian(net, SAMPLES)
    expected = backward(net, list(named.values()))
    torch.testing.assert_close(jacobian(list(named.values())), expected)
    products = jacobian.products(list(named.values()))
    assert isinstance(products, Blocks)
    found = {name for name, part in zip(named, products.parts, strict=True) if isinstance(part, OuterProducts)}
    assert found == outer
    M, N = expected.shape
    w, v = torch.randn(M, dtype=torch.float64), torch.randn(N, dtype=torch.float64)
    assert all(one is named[name] for name, one in net.named_parameters())  # the network keeps its parameters
    torch.testing.assert_close(products.gram(), expected @ expected.mT)
    torch.testing.assert_close(products.rmatvec(w), expected.mT @ w)
    torch.testing.assert_close(products.matvec(v), expected @ v)


def test_uses_of_a_weight_in_torchscript_are_counted() -> None:
    net = Net(lambda net, x: scripted(net.a(x), net.a.weight), a=linear(4)).double()
    parameters = list(net.parameters())
    torch.testing.assert_close(SampleJacobian(net, SAMPLES)(parameters), backward(net, parameters))


def test_it_is_of_the_parameters_that_are_given_in_their_order() -> None:
    torch.manual_seed(0)
    net = nn.Sequential(linear(6), nn.Tanh(), linear(2, 6)).double()
    some = [net[2].weight, net[0].bias]
    torch.testing.assert_close(SampleJacobian(net, SAMPLES)(some), backward(net, some))


def test_parameters_of_two_precisions() -> None:
    torch.manual_seed(0)
    net = Net(lambda net, x: net.b(net.a(x.float()).double()), a=linear(3).float(), b=linear(2, 3).double())
    parameters = list(net.parameters())
    products = SampleJacobian(net, SAMPLES).products(parameters)
    expected = backward(net, parameters).double()
    w, v = torch.randn(expected.shape[0], dtype=torch.float64), torch.randn(expected.shape[1], dtype=torch.float64)
    near = {"rtol": 1e-5, "atol": 1e-5}
    torch.testing.assert_close(products.gram().double(), expected @ expected.mT, **near)
    torch.testing.assert_close(products.rmatvec(w).double(), expected.mT @ w, **near)
    torch.testing.assert_close(products.matvec(v).double(), expected @ v, **near)


def test_rows_of_an_outer_product_are_not_formed() -> None:
    """A weight of 25 million numbers has rows of 4 GB, for 10 samples and 4 outputs."""
    net = nn.Sequential(nn.Linear(5000, 5000), nn.ReLU(), nn.Linear(5000, 4))
    samples = torch.randn(10, 5000)
    parameters = list(net.parameters())
    products = SampleJacobian(net, samples).products(parameters)
    assert isinstance(products, Blocks)
    assert sum(part.rows.numel() for part in products.parts if isinstance(part, Rows)) == 40 * (5000 + 4)
    y = net(samples)
    w = torch.randn_like(y)
    expected = torch.cat([one.flatten() for one in torch.autograd.grad(y, parameters, w)])
    torch.testing.assert_close(products.rmatvec(w.flatten()), expected, rtol=1e-3, atol=1e-4)


class Pair(nn.Module):
    def forward(self, x: Tensor) -> tuple[Tensor, Tensor]:
        return x, x


@pytest.mark.parametrize(
    ("last", "error", "message"),
    [
        (nn.Flatten(0), ValueError, r"network must return \[1, n\] for one sample, got \[3\]: flatten the outputs"),
        (nn.Unflatten(1, (1, 3)), ValueError, r"got \[1, 1, 3\]"),
        (Pair(), TypeError, r"network must return a tensor \[B, n\], got tuple"),
    ],
)
def test_outputs_of_other_forms_are_refused(last: nn.Module, error: type[Exception], message: str) -> None:
    net = nn.Sequential(linear(), last).double()
    with pytest.raises(error, match=message):
        SampleJacobian(net, SAMPLES).products(list(net.parameters()))


def test_batch_normalisation_without_running_statistics_is_refused() -> None:
    """It mixes samples also in evaluation mode."""
    net = nn.Sequential(linear(), nn.BatchNorm1d(3, track_running_stats=False)).double().eval()
    with pytest.raises(ValueError, match=r"a BatchNorm1d without running statistics \('1'\), which mixes samples"):
        SampleJacobian(net, SAMPLES).products(list(net.parameters()))


class Last(nn.Module):
    """The last output of a recurrent network over two vectors per sample."""

    def __init__(self) -> None:
        super().__init__()
        self.inner = nn.GRU(2, 3, batch_first=True)

    def forward(self, x: Tensor) -> Tensor:
        return self.inner(in_rows(x))[0][:, -1]


@pytest.mark.parametrize("make", [Last, lambda: nn.Sequential(linear(), nn.PReLU(), linear(2, 3))])
def test_networks_that_vmap_does_not_know_have_a_jacobian(make: Callable[[], nn.Module]) -> None:
    torch.manual_seed(0)
    net = make().double()
    parameters = list(net.parameters())
    torch.testing.assert_close(SampleJacobian(net, SAMPLES)(parameters), backward(net, parameters))


class Drawing(nn.Module):
    """A layer over two vectors per sample, in training mode; then dropout as a function."""

    def __init__(self, inner: nn.Module, dropout: float = 0.0) -> None:
        super().__init__()
        self.inner, self._dropout = inner, dropout

    def forward(self, x: Tensor) -> Tensor:
        rows = in_rows(x)
        attention = isinstance(self.inner, nn.MultiheadAttention)
        result = self.inner(rows, rows, rows)[0] if attention else self.inner(rows)
        result = (result[0] if isinstance(result, tuple) else result).flatten(1)
        return nn.functional.dropout(result, self._dropout) if self._dropout else result


RECURRENT = {"num_layers": 2, "dropout": 0.5, "batch_first": True}


@pytest.mark.parametrize(
    ("inner", "kind"),
    [
        (nn.GRU(2, 3, **RECURRENT), "GRU with dropout"),
        (nn.LSTM(2, 3, **RECURRENT), "LSTM with dropout"),
        (nn.RNN(2, 3, **RECURRENT), "RNN with dropout"),
        (nn.MultiheadAttention(2, 1, dropout=0.5, batch_first=True), "MultiheadAttention with dropout"),
        (nn.Sequential(nn.Linear(2, 3), nn.RReLU()), "RReLU"),
    ],
)
def test_layers_with_dropout_of_their_own_are_refused_in_training_mode(inner: nn.Module, kind: str) -> None:
    net = Drawing(inner).double()
    jacobian = SampleJacobian(net, SAMPLES)
    for refused in (jacobian, lambda some: move_outputs(net, SAMPLES, torch.zeros(5, 6))):
        with pytest.raises(ValueError, match=rf"network has a {kind} in training mode \('inner.*call network.eval\(\)"):
            refused(list(net.parameters()))
    net.eval()
    torch.testing.assert_close(jacobian(list(net.parameters())), backward(net, list(net.parameters())))


@pytest.mark.parametrize("inner", [nn.Linear(2, 3), nn.GRU(2, 3, batch_first=True)], ids=["vmap", "one by one"])
def test_a_network_that_draws_random_numbers_is_refused(inner: nn.Module) -> None:
    net = Drawing(inner, dropout=0.5).double()
    with pytest.raises(ValueError, match="network draws random numbers, and has no Jacobian per sample"):
        SampleJacobian(net, SAMPLES).products(list(net.parameters()))


def test_dropout_of_rate_zero_is_no_dropout() -> None:
    net = nn.Sequential(nn.Flatten(), nn.Linear(4, 3), nn.Dropout(0.0)).double()
    parameters, inputs = list(net.parameters()), torch.arange(8.0).double().view(2, 4)
    found = SampleJacobian(net, inputs)(parameters)
    net.eval()
    assert torch.equal(found, SampleJacobian(net, inputs)(parameters))


@pytest.mark.parametrize("door", ["jacobian", "move_outputs"])
def test_a_jacobian_in_inference_mode_is_refused(door) -> None:
    network, change = nn.Linear(4, 2).double(), torch.ones(5, 2, dtype=torch.float64)
    doors = {
        "jacobian": lambda: SampleJacobian(network, SAMPLES)(list(network.parameters())),
        "move_outputs": lambda: move_outputs(network, SAMPLES, change),
    }
    with torch.inference_mode(), pytest.raises(RuntimeError, match=r"inference mode forbids: use torch\.no_grad"):
        doors[door]()
