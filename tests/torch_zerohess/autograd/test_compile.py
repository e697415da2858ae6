"""Compiled layers: the numbers of `estimate` with the same seed, or an error."""

import inspect
import warnings

import pytest
import torch
from layers import AGGREGATE, BATCH, IMAGE, SCALAR, SETTINGS, X, close, counting, in_graphs, leaf, network
from torch import Tensor

from torch_zerohess import BlackBox, Memory, Smoothing, estimate
from torch_zerohess.estimation import perturbations

pytestmark = [pytest.mark.usefixtures("fresh_compiler"), in_graphs]

COMPILED = {
    "aggregate": AGGREGATE,
    "optimal": SETTINGS["optimal"],
    "sobol": SETTINGS["sobol"],
    "fr22": AGGREGATE.replace(proposal="fr22"),
    "auto": SETTINGS["auto"],
    "auto, random": Smoothing.auto(sigma=AGGREGATE.sigma, samples=3, seed=12),
}


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("aggregate", "center"),
        ("aggregate", "smoothed"),
        ("optimal", "smoothed"),
        ("sobol", "center"),
        ("fr22", "center"),
        ("auto", "smoothed"),
        ("auto, random", "center"),
    ],
)
def test_compiled(name: str, value: str) -> None:
    smoothing = COMPILED[name]
    fn, calls = counting(IMAGE.f)
    layer, x = BlackBox(fn, smoothing, value=value), leaf(BATCH)
    e = estimate(IMAGE.f, BATCH, smoothing, value=value)
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    y = compiled(x)
    y.sum().backward()
    close(y.detach(), e.value)
    close(x.grad, e.gradient.sum((1, 2)))
    # At most one call more, at zero, to learn the shape of the output.
    assert calls in ([e.evaluations], [1, e.evaluations])
    with torch.no_grad():
        close(compiled(BATCH), e.value)


def test_compiled_layer_sees_new_settings() -> None:
    layer = BlackBox(SCALAR.f, AGGREGATE)
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    for smoothing in (AGGREGATE, AGGREGATE.replace(sigma=0.05), AGGREGATE.replace(samples=3), AGGREGATE):
        layer.smoothing, x = smoothing, leaf(BATCH)
        compiled(x).sum().backward()
        close(x.grad, estimate(SCALAR.f, BATCH, smoothing).gradient)


def test_compiled_layer_stores_perturbations_whatever_their_size(monkeypatch: pytest.MonkeyPatch) -> None:
    """Dynamo traces no function that draws them again."""
    monkeypatch.setattr(perturbations, "STORED", 0)
    x = leaf(BATCH)
    torch.compile(BlackBox(SCALAR.f, AGGREGATE), fullgraph=True, backend="aot_eager")(x).sum().backward()
    close(x.grad, estimate(SCALAR.f, BATCH, AGGREGATE).gradient)


@pytest.mark.usefixtures("quick_inductor")
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_compiled_inside_a_network(backend: str) -> None:
    model, inputs = network(BlackBox(IMAGE.f, AGGREGATE))
    model(inputs).square().sum().backward()
    expected = [p.grad.clone() for p in model.parameters()]
    model.zero_grad()
    torch.compile(model, fullgraph=True, backend=backend)(inputs).square().sum().backward()
    for p, gradient in zip(model.parameters(), expected, strict=True):
        close(p.grad, gradient)


@pytest.mark.usefixtures("quick_inductor")
@pytest.mark.parametrize(("value", "backend"), [("center", "aot_eager"), ("smoothed", "inductor")])
def test_a_compiled_layer_refuses_a_trainable_head_where_gradients_are_wanted(value: str, backend: str) -> None:
    """Compiled code runs its graph without autograd, whatever the caller wants."""
    w = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    layer = BlackBox(SCALAR.f, AGGREGATE, head=lambda loss: w * loss, value=value)
    compiled = torch.compile(layer, fullgraph=True, backend=backend)
    for x in (BATCH, leaf(BATCH)):
        with pytest.raises(ValueError, match="head depends on a tensor that requires grad"):
            compiled(x)
    with torch.no_grad():
        for x in (BATCH, leaf(BATCH)):
            close(compiled(x), layer(x))
    with pytest.raises(ValueError, match="head depends on a tensor that requires grad"):
        torch.func.grad(lambda x: layer(x).sum())(BATCH)


def sensor(z: Tensor) -> Tensor:
    """A wave between two Fourier transforms, of which torch does not compute the conjugate before it is used."""
    return torch.fft.ifft(torch.fft.fft(z).conj()).real[:, 1] + (1j * z).conj().imag[:, 0]


def mapped(z: Tensor) -> Tensor:
    """A simulator of one point that is mapped over a batch, by its gradient."""
    return torch.func.vmap(torch.func.grad(lambda one: one.sin().prod()))(z).sum(1)


def differentiating(z: Tensor) -> Tensor:
    """A solver that differentiates inside, by operations that torch maps over in its own way."""
    with torch.enable_grad():
        return torch.autograd.functional.jacobian(lambda one: one.sin().prod(1), z, vectorize=True).sum((1, 2))


def scripted(z: Tensor) -> Tensor:
    return torch.jit.trace(lambda one: one.sin().prod(1), z)(z)


@pytest.mark.parametrize(
    ("fn", "seen"),
    [(sensor, False), (sensor, True), (mapped, False), (differentiating, False), (scripted, False)],
    ids=["sensor", "sensor that was called before", "mapped", "differentiating", "scripted"],
)
@pytest.mark.filterwarnings("ignore:.*torch.jit:FutureWarning", "ignore:.*torch.jit:DeprecationWarning")
def test_the_call_that_compiles_runs_the_function_as_every_call_does(fn, seen: bool) -> None:
    """It hides most of torch from its operators: the conjugates that are not computed yet, `torch.func`, autograd.

    It asks for the shape of the output first, unless an earlier call has shown it.
    """
    layer, again = BlackBox(fn, AGGREGATE), BlackBox(fn, AGGREGATE)
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    x, y = leaf(BATCH), leaf(BATCH)
    expected = again(y)
    expected.sum().backward()
    if seen:
        layer(BATCH)
    result = compiled(x)
    close(result.detach(), expected.detach())
    result.sum().backward()
    close(x.grad, y.grad)
    with torch.no_grad():  # another graph
        close(compiled(BATCH.clone()), expected.detach())


@pytest.mark.usefixtures("quick_inductor")
def test_outputs_of_any_strides_in_compiled_code() -> None:
    """Compiled code reads the outputs by the strides of the fake kernel."""
    layer = BlackBox(lambda z: torch.stack([z[:, 0], z.sum(1), z.prod(1)]).T, AGGREGATE)
    model = torch.nn.Sequential(layer, torch.nn.Linear(3, 2, dtype=torch.float64))
    x = BATCH.reshape(-1, BATCH.shape[-1])
    with torch.no_grad():
        close(torch.compile(model, fullgraph=True, backend="inductor")(x), model(x))


SECOND = {
    "jacfwd of jacrev": lambda f: torch.func.hessian(f),
    "jacrev of jacfwd": lambda f: torch.func.jacrev(torch.func.jacfwd(f)),
    "jacrev of jacrev": lambda f: torch.func.jacrev(torch.func.jacrev(f)),
}
TWICE_FORWARD = {
    "jacfwd of jacfwd": lambda f: torch.func.jacfwd(torch.func.jacfwd(f)),
    "jvp of jvp": lambda f: lambda x: directional(lambda y: directional(f, y), x),
}


def directional(f, x: Tensor) -> Tensor:
    return torch.func.jvp(f, (x,), (torch.ones_like(x),))[1]


@pytest.mark.parametrize(
    ("proposal", "way"),
    [("aggregate", "jacfwd of jacrev"), ("aggregate", "jacrev of jacrev"), ("optimal", "jacrev of jacfwd")],
)
def test_second_derivatives_inside_of_compiled_code(proposal: str, way: str) -> None:
    smoothing, x = SETTINGS[proposal], X.clone()
    layer = BlackBox(SCALAR.f, smoothing)
    hessian = torch.compile(SECOND[way](layer), fullgraph=True, backend="aot_eager")(x)
    close(hessian, estimate(SCALAR.f, x, smoothing).hessian())


@pytest.mark.parametrize("way", TWICE_FORWARD.values(), ids=TWICE_FORWARD.keys())
def test_forward_mode_of_forward_mode_is_not_compiled(way) -> None:
    """The compiler of torch fails there. With fullgraph=True our error says what to use, and without it nothing fails.

    The aggregate weights have a product with a number, at which torch reports an internal assertion.
    """
    layer, x = BlackBox(SCALAR.f, AGGREGATE), X.clone()
    with pytest.raises(Exception, match=r"use torch\.func\.hessian in place of jacfwd of jacfwd"):
        torch.compile(way(layer), fullgraph=True, backend="aot_eager")(x)
    torch.compiler.reset()
    close(torch.compile(way(layer), backend="aot_eager")(x), way(layer)(x))


class Between(torch.nn.Module):
    """A layer with a memory between two operations of torch."""

    def __init__(self) -> None:
        super().__init__()
        self.layer = BlackBox(IMAGE.f, AGGREGATE, memory=Memory())

    def forward(self, x: Tensor) -> Tensor:
        y = x.sin()
        z = self.layer(y)
        return z.square().sum()


def test_a_layer_with_a_memory_is_one_graph_break_without_warnings() -> None:
    graphs = []

    def backend(graph: torch.fx.GraphModule, inputs: list[Tensor]) -> torch.fx.GraphModule:
        graphs.append(graph)
        return graph

    plain, model = Between(), Between()
    compiled = torch.compile(model, backend=backend)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")  # torch hides some of its own, but not where they are errors
        for _ in range(2):
            x, y = leaf(BATCH), leaf(BATCH)
            plain(x).backward()
            compiled(y).backward()
            assert torch.equal(x.grad, y.grad)
    assert [str(one.message) for one in caught] == []
    assert len(graphs) == 2
    calls = []
    model.layer.register_forward_hook(lambda *_: calls.append(1))
    compiled(leaf(BATCH))
    assert len(calls) == 1
    plain(leaf(BATCH))
    assert model.layer.memory.evaluations == plain.layer.memory.evaluations > 0
    torch.compiler.reset()
    with pytest.raises(RuntimeError, match="the memory of a layer changes from call to call"):
        torch.compile(model, fullgraph=True, backend="eager")(x)


@pytest.mark.parametrize("way", ["isolated", "one model"])
def test_more_layers_than_the_recompile_limit(way: str) -> None:
    if way == "isolated" and "isolate_recompiles" not in inspect.signature(torch.compile).parameters:
        pytest.skip("this torch has no isolate_recompiles")
    layers, x = [BlackBox(SCALAR.f, AGGREGATE) for _ in range(2)], leaf(BATCH)
    with torch._dynamo.config.patch(recompile_limit=1):
        if way == "isolated":
            for layer in layers:
                torch.compile(layer, fullgraph=True, backend="eager", isolate_recompiles=True)(x).sum().backward()
        else:
            torch.compile(lambda x: layers[0](x) + layers[1](x), fullgraph=True, backend="eager")(x).sum().backward()
    close(x.grad, 2 * estimate(SCALAR.f, BATCH, AGGREGATE).gradient)


@pytest.mark.parametrize(("name", "by"), [("aggregate", "backward"), *((name, "grad") for name in COMPILED)])
def test_double_backward_of_a_compiled_layer_is_an_error(name: str, by: str) -> None:
    x = leaf()
    y = torch.compile(BlackBox(SCALAR.f, COMPILED[name]), fullgraph=True, backend="aot_eager")(x)
    (gradient,) = torch.autograd.grad(y, x, create_graph=True)
    loss = (gradient * x).sum()
    # Its derivative is g + H x: without an error it would come out as g, a wrong number.
    with pytest.raises((RuntimeError, ValueError)):
        loss.backward() if by == "backward" else torch.autograd.grad(loss, x)


def test_operators_keep_the_promises_of_their_fake_kernels() -> None:
    layer, ops = BlackBox(IMAGE.f, AGGREGATE), torch.ops.torch_zerohess
    tests = ("test_schema", "test_faketensor")
    for value in ("center", "smoothed"):
        layer = BlackBox(IMAGE.f, AGGREGATE, value=value)
        for keep in (True, False):
            arguments = (layer._handle, 12, keep, True, BATCH, [])
            torch.library.opcheck(ops.evaluate.default, arguments, test_utils=tests)
    torch.library.opcheck(ops.evaluate_center.default, (layer._handle, True, BATCH, []), test_utils=tests)
