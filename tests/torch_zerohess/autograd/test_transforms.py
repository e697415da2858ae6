"""Each question about torch's transforms, asked where the answer is known."""

import threading

import pytest
import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx

import torch_zerohess as zh
from torch_zerohess.autograd import transforms
from torch_zerohess.autograd.graph import black_box_inputs
from torch_zerohess.autograd.marker import Input
from truths import spread, vector

X, V = vector(0.3, -0.7), vector(1.0, 2.0)


def answers(question, ask) -> list[bool]:
    """What `question` says of the tensor that a transform hands to a function; ask: (function) -> None."""
    found: list[bool] = []

    def fn(x: Tensor) -> Tensor:
        found.append(question(x))
        return x.square().sum()

    ask(fn)
    return found


TRANSFORMS = {
    "grad": lambda fn: torch.func.grad(fn)(X),
    "jvp": lambda fn: torch.func.jvp(fn, (X,), (V,)),
    "vmap": lambda fn: torch.func.vmap(fn)(X[None]),
}


@pytest.mark.parametrize("name", TRANSFORMS)
def test_functorch_transforms_are_seen(name: str) -> None:
    assert answers(lambda x: transforms.transform_active(), TRANSFORMS[name]) == [True]
    assert answers(transforms.watched, TRANSFORMS[name]) == [True]
    assert answers(transforms.derivative_possible, TRANSFORMS[name]) == [True]
    assert answers(transforms.derivative_wanted, TRANSFORMS[name]) == [name != "vmap"]


def test_plain_tensors_are_not_watched() -> None:
    for x in (X, X.clone().requires_grad_(), torch.nn.Parameter(X)):
        assert not transforms.transform_active()
        assert not transforms.forward_mode_active()
        assert not transforms.watched(x)
        assert transforms.derivative_wanted(x) == transforms.derivative_possible(x) == x.requires_grad
        with torch.no_grad():
            assert not transforms.derivative_possible(x)


def test_wrapped_tensors_are_looked_into_at_every_level() -> None:
    leaf, found = X.clone().requires_grad_(), []

    def fn(_: Tensor) -> Tensor:
        found.append((transforms.derivative_wanted(leaf), transforms.derivative_wanted(leaf.detach())))
        return leaf.sum() * 0

    torch.func.vmap(fn)(X[None])
    assert found == [(True, False)]
    # vmap over a tensor that requires grad outside of it.
    assert answers(transforms.derivative_wanted, lambda fn: torch.func.vmap(fn)(leaf[None])) == [True]


def test_the_first_element_of_nested_maps_is_shown() -> None:
    x, found = torch.arange(24.0).view(2, 3, 4), []

    def fn(one: Tensor) -> Tensor:
        with transforms.outside():
            found.append(transforms.shown(one))
        return one

    torch.func.vmap(torch.func.vmap(fn, in_dims=1))(x)  # [3]
    assert torch.equal(found[0], x[0, :, 0])


def test_forward_mode_is_seen_where_there_is_a_tangent() -> None:
    with forward_ad.dual_level():
        assert transforms.forward_mode_active()
        assert transforms.derivative_wanted(forward_ad.make_dual(X, V))
        assert not transforms.derivative_wanted(X)
    assert not transforms.forward_mode_active()


def test_forward_mode_in_another_thread_changes_nothing_here() -> None:
    layer, x = zh.BlackBox(lambda z: z.square().sum(1), zh.Smoothing(sigma=0.5, samples=2, seed=0)), X.clone()
    entered, leave = threading.Event(), threading.Event()

    def differentiate() -> None:
        with forward_ad.dual_level():
            entered.set()
            leave.wait(10)

    other = threading.Thread(target=differentiate)
    other.start()
    try:
        assert entered.wait(10)
        assert transforms.forward_mode_active()
        assert not transforms.has_tangent(x)
        w = x.requires_grad_()
        gauss_newton = zh.CurvatureOperator(layer(2 * w), w, mode="gauss_newton")
    finally:
        leave.set()
        other.join()
    torch.testing.assert_close(gauss_newton @ V, zh.CurvatureOperator(layer(2 * w), w, mode="exact") @ V)


class Tagged(Tensor):
    """A subclass, as other packages make them."""


def test_dispatch_modes_and_subclasses_are_seen() -> None:
    assert answers(transforms.watched, lambda fn: make_fx(fn)(X)) == [True]
    assert transforms.watched(X.as_subclass(Tagged))


def test_a_traced_layer_calls_the_function_when_the_trace_runs() -> None:
    """make_fx records the operator, not one draw of its numbers."""
    calls: list[int] = []

    def fn(z: Tensor) -> Tensor:
        calls.append(len(z))
        return z.square().sum(1)

    layer = zh.BlackBox(fn, zh.Smoothing(sigma=0.5, samples=3, seed=0))
    traced = make_fx(torch.func.grad(layer))(X)
    calls.clear()
    other = vector(1.0, 2.0)
    torch.testing.assert_close(traced(other), torch.func.grad(layer)(other))
    assert calls == [7, 7]


def test_symbolic_zeros_are_seen() -> None:
    assert transforms.is_symbolic_zero(torch._efficientzerotensor((2,)))
    assert not transforms.is_symbolic_zero(torch.zeros(2))


def test_nodes_tell_which_function_made_them() -> None:
    x = X.clone().requires_grad_()
    assert transforms.made_by(Input.apply(x).grad_fn, Input)
    assert not transforms.made_by((2 * x).grad_fn, Input)
    assert not transforms.made_by(None, Input)


def test_the_input_marker_is_the_identity_and_remembers_its_input() -> None:
    x = spread(6, -1.0, 1.0).view(2, 3).requires_grad_()
    y = Input.apply(x)
    assert torch.equal(y, x)
    assert y.grad_fn.saved_tensors[0] is x
    assert torch.autograd.gradcheck(Input.apply, x)
    fn, smoothing = lambda z: z.sum(1), zh.Smoothing(sigma=0.5, samples=2, seed=0)
    assert [one is x for one in black_box_inputs(zh.BlackBox(fn, smoothing, memory=zh.Memory())(x))] == [True]
    out = zh.BlackBox(fn, smoothing)(x)
    assert [one is x for one in black_box_inputs(out)] == [True]
    (slope,) = torch.autograd.grad(out.sum(), x, create_graph=True)
    assert [one is x for one in black_box_inputs(slope)] == [True]
    slopes = torch.vmap(lambda one: torch.autograd.grad(out, x, one, create_graph=True)[0])(torch.eye(2).to(out))
    assert [one is x for one in black_box_inputs(slopes)] == [True]


def test_a_failing_probe_says_what_to_do() -> None:
    """Compiling needs the shape of the output: the function is called at zero, where it may fail."""

    def fn(z: Tensor) -> Tensor:
        if bool((z == 0).all()):
            raise KeyError("nothing at zero")
        return z.square().sum(1)

    layer, x = zh.BlackBox(fn, zh.Smoothing(sigma=0.5, samples=2, seed=0)), X.clone().requires_grad_()
    with pytest.raises(RuntimeError, match="call the layer once on real data before compiling it"):
        make_fx(layer, tracing_mode="fake")(x)
    expected = torch.autograd.grad(layer(x), x)[0]
    torch.testing.assert_close(torch.autograd.grad(torch.compile(layer, backend="aot_eager")(x), x)[0], expected)
