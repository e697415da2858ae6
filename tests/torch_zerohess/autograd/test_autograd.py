"""The layer under every transform of torch: its derivatives are those of `estimate` with the same seed, to rounding."""

import copy
import io
import pickle

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad, gradcheck, gradgradcheck

from torch_zerohess import BlackBox, Smoothing, estimate, smooth
from torch_zerohess.estimation import perturbations
from torch_zerohess.sampling import kernels
from truths import Image, spread, truths, vector

# torch's own forward mode compiles decompositions with its deprecated torch.jit.
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.script` is deprecated")

N = 3
T = truths(N)
SCALAR, IMAGE = T["wave"], Image((T["wave"], T["exponential"], T["bump"], T["step"]))
X, V, BATCH = spread(N, -0.6, 0.7), spread(N, -1.0, 1.0), spread(4 * N, -1.0, 1.0).view(4, N)
AGGREGATE = Smoothing(sigma=spread(N, 0.3, 0.8), samples=6, seed=12)
SETTINGS = {
    "aggregate": AGGREGATE,
    "mean of the others": AGGREGATE.replace(antithetic=False, baseline="mean"),
    "gaussian": AGGREGATE.replace(proposal="gaussian", baseline="none", antithetic=False),
    "optimal": AGGREGATE.replace(proposal="optimal"),
    "uniform": AGGREGATE.replace(proposal="uniform", samples=40),
    "sobol": AGGREGATE.replace(sampler="sobol"),
    "orthogonal": AGGREGATE.replace(sampler="orthogonal"),
    "auto": Smoothing.auto(sigma=AGGREGATE.sigma, samples=24, seed=12),  # 48 Sobol points
}
EVERY = pytest.mark.parametrize("smoothing", SETTINGS.values(), ids=SETTINGS.keys())


@pytest.fixture(params=["stored", "redrawn"])
def memory(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Perturbations kept, or drawn again for every sum."""
    if request.param == "redrawn":
        monkeypatch.setattr(perturbations, "STORED", 0)
        monkeypatch.setattr(kernels, "_CHUNK", 2 * N)  # a row or two at a time


BOTH = pytest.mark.usefixtures("memory")


def close(got: Tensor, expected: Tensor) -> None:
    assert got.dtype == expected.dtype
    # Rounding only; sums have about a hundred terms.
    torch.testing.assert_close(got, expected, rtol=1e-11, atol=1e-11 * (1 + float(expected.abs().max())))


def leaf(x: Tensor = X) -> Tensor:
    return x.clone().requires_grad_()


@BOTH
@EVERY
@pytest.mark.parametrize("value", ["center", "smoothed"])
def test_backward_and_double_backward(smoothing: Smoothing, value: str) -> None:
    e = estimate(SCALAR.f, BATCH, smoothing, value=value)
    layer, x = BlackBox(SCALAR.f, smoothing, value=value), leaf(BATCH)
    y = layer(x)
    close(y.detach(), e.value)
    (gradient,) = torch.autograd.grad(y.sum(), x, create_graph=True)
    close(gradient.detach(), e.gradient)
    rows = [torch.autograd.grad(gradient[:, i].sum(), x, retain_graph=True)[0] for i in range(N)]
    close(torch.stack(rows, 1), e.hessian())
    layer(x).sum().backward()
    close(x.grad, e.gradient)


@BOTH
def test_tensor_valued() -> None:
    e, x = estimate(IMAGE.f, BATCH, AGGREGATE), leaf(BATCH)
    y = BlackBox(IMAGE.f, AGGREGATE)(x)
    assert y.shape == (4, 2, 2)
    w = spread(16, -1.0, 1.0).view(4, 2, 2)
    (gradient,) = torch.autograd.grad(y, x, w, create_graph=True)
    close(gradient.detach(), torch.einsum("bpq,bpqi->bi", w, e.gradient))
    (product,) = torch.autograd.grad(gradient, x, V.expand(4, N))
    close(product, torch.einsum("bpq,bpqi->bi", w, e.hvp(V)))
    layer, one = BlackBox(IMAGE.f, AGGREGATE), estimate(IMAGE.f, X, AGGREGATE)
    close(torch.func.jacrev(layer)(X), one.gradient)
    close(torch.func.jacfwd(layer)(X), one.gradient)
    close(torch.func.hessian(layer)(X), one.hessian())


@BOTH
@EVERY
def test_autograd_functional(smoothing: Smoothing) -> None:
    functional, f = torch.autograd.functional, smooth(SCALAR.f, smoothing)
    e = estimate(SCALAR.f, X, smoothing)
    hessian = e.hessian()
    close(functional.hessian(f, X), hessian)
    close(functional.hessian(f, X, vectorize=True), hessian)
    close(functional.hessian(f, X, vectorize=True, outer_jacobian_strategy="forward-mode"), hessian)
    close(functional.jacobian(f, X, vectorize=True, strategy="forward-mode"), e.gradient)
    close(functional.hvp(f, X, V)[1], hessian @ V)
    close(functional.vhp(f, X, V)[1], hessian @ V)
    close(functional.jvp(f, X, V)[1], e.gradient @ V)


@pytest.mark.parametrize("sampler", ["random", "sobol", "orthogonal"])
def test_a_fresh_seed_under_every_transform(sampler: str) -> None:
    smoothing = AGGREGATE.replace(seed=None, sampler=sampler)
    f, functional, func = smooth(SCALAR.f, smoothing), torch.autograd.functional, torch.func
    forward = {"vectorize": True, "outer_jacobian_strategy": "forward-mode"}
    ways = {
        "func.hessian": lambda: func.hessian(f)(X),
        "jacrev of jacrev": lambda: func.jacrev(func.jacrev(f))(X),
        "vmap": lambda: func.vmap(func.hessian(f))(X[None])[0],
        "functional.hessian": lambda: functional.hessian(f, X, vectorize=True),
        "functional.hessian, forward": lambda: functional.hessian(f, X, **forward),
    }
    torch.manual_seed(7)
    expected = estimate(SCALAR.f, X, smoothing).hessian()
    for name, way in ways.items():
        torch.manual_seed(7)
        torch.testing.assert_close(way(), expected, rtol=1e-11, atol=1e-11, msg=lambda text, name=name: name + text)


@BOTH
@EVERY
def test_func(smoothing: Smoothing) -> None:
    func, f = torch.func, smooth(SCALAR.f, smoothing)
    e = estimate(SCALAR.f, X, smoothing)
    hessian, gradient, value = e.hessian(), e.gradient, SCALAR.f(X[None])[0]
    close(func.grad(f)(X), gradient)
    close(func.grad_and_value(f)(X)[1], value)
    close(torch.stack(func.jvp(f, (X,), (V,))), torch.stack([value, gradient @ V]))
    close(func.vjp(f, X)[1](torch.ones_like(value))[0], gradient)
    close(func.jacrev(f)(X), gradient)
    close(func.jacfwd(f)(X), gradient)
    for second in (func.hessian(f), func.jacrev(func.jacrev(f)), func.jacfwd(func.jacfwd(f))):
        close(second(X), hessian)
    close(func.jacrev(func.jacfwd(f))(X), hessian)
    close(func.jvp(func.grad(f), (X,), (V,))[1], hessian @ V)
    close(func.vjp(func.grad(f), X)[1](V)[0], hessian @ V)


@BOTH
@EVERY
def test_vmap(smoothing: Smoothing) -> None:
    func, f, e = torch.func, smooth(SCALAR.f, smoothing), estimate(SCALAR.f, BATCH, smoothing)
    close(func.vmap(f)(BATCH), e.value)
    close(func.vmap(f, in_dims=1)(BATCH.mT.contiguous()), e.value)
    close(func.vmap(func.grad(f))(BATCH), e.gradient)
    close(func.vmap(func.jacfwd(f))(BATCH), e.gradient)
    close(func.vmap(func.hessian(f))(BATCH), e.hessian())
    close(func.vmap(func.jacrev(func.jacrev(f)))(BATCH), e.hessian())
    nested = func.vmap(func.vmap(func.grad(f)))(BATCH.view(2, 2, N))
    close(nested, e.gradient.view(2, 2, N))


NOT_CONTIGUOUS = {
    "transposed": BATCH.mT.contiguous().mT,
    "expanded": X.expand(4, N),
    "sliced": BATCH.repeat_interleave(2, 1)[:, ::2],
}


@BOTH
@pytest.mark.parametrize("x", NOT_CONTIGUOUS.values(), ids=NOT_CONTIGUOUS.keys())
def test_points_that_are_not_contiguous(x: Tensor) -> None:
    assert not x.is_contiguous()
    func, layer, e = torch.func, BlackBox(SCALAR.f, AGGREGATE), estimate(SCALAR.f, x, AGGREGATE)
    at = x.detach().requires_grad_()
    for f in (layer, layer.freeze(x)):
        close(torch.autograd.grad(f(at).sum(), at)[0], e.gradient)
    close(func.grad(lambda z: layer(z).sum())(x), e.gradient)
    close(func.vmap(func.grad(layer))(x), e.gradient)
    close(func.vmap(func.hessian(layer), in_dims=1)(x.mT), e.hessian())


def test_perturbations_of_a_large_batch_under_vmap_are_drawn_again(monkeypatch: pytest.MonkeyPatch) -> None:
    stored: list[bool] = []
    original = kernels.accumulate
    monkeypatch.setattr(kernels, "accumulate", lambda u, a: stored.append(isinstance(u, Tensor)) or original(u, a))
    monkeypatch.setattr(perturbations, "STORED", 2 * N * 12)  # enough for two points
    func, expected = torch.func, estimate(SCALAR.f, BATCH, AGGREGATE).gradient
    pair = smooth(lambda z, a: SCALAR.f(z) * a, AGGREGATE)
    layer, ones = smooth(SCALAR.f, AGGREGATE), torch.ones(2, 2, dtype=torch.float64)
    for large, gradient in {
        False: lambda: func.vmap(func.grad(layer))(BATCH[:2]),
        True: lambda: func.vmap(func.grad(layer))(BATCH),
    }.items():
        stored.clear()
        close(gradient(), expected if large else expected[:2])
        assert stored == [not large]
    for gradient in (
        lambda: func.vmap(func.vmap(func.grad(layer)))(BATCH.view(2, 2, N)),
        lambda: func.vmap(func.vmap(func.grad(pair), in_dims=(None, 0)))(BATCH[:2], ones),
    ):
        stored.clear()
        gradient()
        assert stored == [False]


def test_randomness_of_vmap_is_honoured_or_refused() -> None:
    layer, func = BlackBox(SCALAR.f, AGGREGATE.replace(seed=None)), torch.func
    same_points, factors = X.expand(3, N), torch.ones(3, dtype=torch.float64)

    def mapped(randomness: str) -> Tensor:
        return func.vmap(func.grad(layer), randomness=randomness)(same_points)

    def shared(randomness: str) -> Tensor:
        return func.vmap(lambda factor: factor * func.grad(layer)(X), randomness=randomness)(factors)

    assert len(mapped("different").unique(dim=0)) == len(mapped("error").unique(dim=0)) == 3
    assert len(shared("same").unique(dim=0)) == len(shared("error").unique(dim=0)) == 1
    refused = {mapped: ("same", "its noise is independent for each"), shared: ("different", "inputs are not mapped")}
    for call, (randomness, message) in refused.items():
        with pytest.raises(ValueError, match=message):
            call(randomness)
        torch.compiler.reset()
        with pytest.raises(Exception, match=message):
            torch.compile(call, fullgraph=True, backend="aot_eager")(randomness)
    layer.smoothing = AGGREGATE
    torch.testing.assert_close(mapped("same"), estimate(SCALAR.f, same_points, AGGREGATE).gradient)
    torch.testing.assert_close(shared("different"), estimate(SCALAR.f, X, AGGREGATE).gradient.expand(3, N))


def test_vmap_with_auxiliary_inputs() -> None:
    def scaled(z: Tensor, a: Tensor) -> Tensor:
        return SCALAR.f(z) * a

    f, a = smooth(scaled, AGGREGATE), vector(1.0, -2.0, 0.5, 3.0)
    gradient = estimate(SCALAR.f, BATCH, AGGREGATE).gradient
    close(torch.func.vmap(torch.func.grad(f))(BATCH, a), a[:, None] * gradient)
    close(torch.func.vmap(torch.func.grad(f), in_dims=(0, None))(BATCH, a[1]), -2.0 * gradient)


@BOTH
@EVERY
def test_forward_mode(smoothing: Smoothing) -> None:
    f, e = smooth(SCALAR.f, smoothing), estimate(SCALAR.f, X, smoothing)
    with forward_ad.dual_level():
        value, tangent = forward_ad.unpack_dual(f(forward_ad.make_dual(X, V)))
        close(value, e.value)
        close(tangent, e.gradient @ V)
        dual = forward_ad.make_dual(leaf(), V)
        (gradient,) = torch.autograd.grad(f(dual), dual, create_graph=True)
        close(forward_ad.unpack_dual(gradient).tangent.detach(), e.hvp(V))
    with torch.no_grad(), forward_ad.dual_level():
        close(forward_ad.unpack_dual(f(forward_ad.make_dual(X, V))).tangent, e.gradient @ V)


@BOTH
@EVERY
def test_frozen_samples_pass_gradcheck_in_every_mode(smoothing: Smoothing) -> None:
    frozen, e = BlackBox(IMAGE.f, smoothing).freeze(BATCH[:2]), estimate(IMAGE.f, BATCH[:2], smoothing)
    at = leaf(BATCH[:2])
    close(frozen(at).detach(), e.value)
    close(torch.autograd.grad(frozen(at).sum(), at)[0], e.gradient.sum((1, 2)))
    near = leaf(BATCH[:2] + 0.05)  # away from where all terms of d vanish
    assert gradcheck(frozen, near, check_forward_ad=True, check_batched_grad=True, check_batched_forward_grad=True)
    assert gradgradcheck(frozen, near, check_fwd_over_rev=True, check_batched_grad=True)


def test_frozen_samples_follow_the_smoothed_function() -> None:
    # 4000 pairs: re-weighted to a point 0.3 sigma away they still tell its value and gradient.
    smoothing = Smoothing(sigma=0.5, samples=4000, seed=1, sampler="sobol")
    layer, x = BlackBox(SCALAR.f, smoothing, value="smoothed"), leaf(X + 0.15)
    sigma = smoothing.sigma_vector(N, x.device)
    y = layer.freeze(X)(x)
    close_to = {"rtol": 0.0, "atol": 0.05}  # ten times the scatter of 20 seeds
    torch.testing.assert_close(y.detach(), SCALAR.value(x.detach(), sigma), **close_to)
    torch.testing.assert_close(torch.autograd.grad(y, x)[0], SCALAR.gradient(x.detach(), sigma), **close_to)


@pytest.mark.parametrize("smoothing", [AGGREGATE.replace(proposal="fr22"), AGGREGATE.replace(order=1, samples=9)])
def test_first_order_samples_serve_first_derivatives(smoothing: Smoothing) -> None:
    e, f = estimate(SCALAR.f, X, smoothing), smooth(SCALAR.f, smoothing)
    close(torch.func.grad(f)(X), e.gradient)
    close(torch.func.jacfwd(f)(X), e.gradient)
    x = leaf()
    f(x).backward()
    close(x.grad, e.gradient)


def network(layer: nn.Module) -> tuple[nn.Module, Tensor]:
    torch.manual_seed(3)
    before = nn.Sequential(nn.Linear(2, 5), nn.Tanh(), nn.Linear(5, N))
    after = nn.Sequential(nn.Flatten(), nn.Linear(4, 2), nn.Softplus())
    return nn.Sequential(before, layer, after).double(), spread(8, -1.0, 1.0).view(4, 2)


@BOTH
def test_chain_with_networks_before_and_after() -> None:
    model, inputs = network(BlackBox(IMAGE.f, AGGREGATE))
    loss = model(inputs).square().sum()
    weight = model[0][0].weight
    parts = torch.autograd.grad(loss, [weight, model[2][1].weight], create_graph=True)
    # By hand: the estimated Jacobian between the analytic ones.
    z = model[0](inputs)
    e = estimate(IMAGE.f, z.detach(), AGGREGATE)
    y = e.value.requires_grad_()
    tail = model[2](y).square().sum()
    slope, last = torch.autograd.grad(tail, [y, model[2][1].weight])
    (first,) = torch.autograd.grad(z, weight, torch.einsum("bpq,bpqi->bi", slope, e.gradient))
    close(parts[0].detach(), first)
    close(parts[1].detach(), last)
    # Second order through all three, on the output of the network before: l' H + J^T l'' J.
    x = leaf(BATCH[:1])
    tail = lambda out: model[2](out).square().sum()  # noqa: E731
    hessian = torch.autograd.functional.hessian(lambda p: tail(BlackBox(IMAGE.f, AGGREGATE)(p)), x)[0, :, 0]
    one = estimate(IMAGE.f, x, AGGREGATE)
    J, l1 = one.gradient.reshape(4, N), torch.func.grad(tail)(one.value).reshape(4)
    l2 = torch.func.jacrev(torch.func.jacrev(tail))(one.value).reshape(4, 4)
    close(hessian.detach(), (J.mT @ l2 @ J + torch.einsum("p,pij->ij", l1, one.hessian().reshape(4, N, N))).detach())


def counting(f):
    calls: list[int] = []

    def fn(z: Tensor) -> Tensor:
        assert not z.requires_grad
        assert not torch.is_grad_enabled()
        calls.append(len(z))
        return f(z)

    return fn, calls


def test_value_gradient_and_hessian_cost_one_call() -> None:
    def by_backward(f) -> None:
        x = leaf()
        (g,) = torch.autograd.grad(f(x), x, create_graph=True)
        torch.autograd.grad(g, x, V, retain_graph=True)
        torch.autograd.grad(g[0], x)

    def by_dual(f) -> None:
        with forward_ad.dual_level():
            f(forward_ad.make_dual(X, V))

    one_point = [
        by_backward,
        by_dual,
        lambda f: torch.func.hessian(f)(X),
        lambda f: torch.func.jacrev(torch.func.jacrev(f))(X),
        lambda f: torch.func.jacfwd(f)(X),
        lambda f: torch.autograd.functional.hessian(f, X, vectorize=True),
        lambda f: f(leaf()),
    ]
    for ask in one_point:
        fn, calls = counting(SCALAR.f)
        ask(smooth(fn, AGGREGATE))
        assert calls == [13]
    fn, calls = counting(SCALAR.f)
    torch.func.vmap(torch.func.hessian(smooth(fn, AGGREGATE)))(BATCH)
    assert calls == [4 * 13]


def test_only_the_value_where_no_derivative_can_be_asked_for() -> None:
    fn, calls = counting(SCALAR.f)
    layer = BlackBox(fn, AGGREGATE)
    with torch.no_grad():
        close(layer(leaf(BATCH)), SCALAR.f(BATCH))
    close(layer(BATCH), SCALAR.f(BATCH))
    with torch.inference_mode():
        close(layer(BATCH), SCALAR.f(BATCH))
    assert calls == [4, 4, 4]
    assert not layer(BATCH).requires_grad
    # The smoothed value needs its samples in any case.
    calls.clear()
    with torch.no_grad():
        close(BlackBox(fn, AGGREGATE, value="smoothed")(X), estimate(fn, X, AGGREGATE, value="smoothed").value)
    assert calls == [13, 13]


def test_auxiliary_inputs_are_not_differentiated() -> None:
    layer, a = BlackBox(lambda z, a: SCALAR.f(z) * a, AGGREGATE), torch.tensor(2.0, requires_grad=True)
    with pytest.raises(ValueError, match=r"aux\[0\] requires grad.*detached"):
        layer(leaf(), a)
    x = leaf()
    layer(x, a.detach()).backward()
    close(x.grad, 2.0 * estimate(SCALAR.f, X, AGGREGATE).gradient)
    with torch.no_grad():
        close(layer(X, a), 2.0 * SCALAR.f(X[None])[0])


@pytest.mark.parametrize("returned", [torch.float16, torch.float32, torch.float64])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_of_the_input_is_that_of_the_output(dtype: torch.dtype, returned: torch.dtype) -> None:
    layer, x = BlackBox(lambda z: SCALAR.f(z).to(returned), AGGREGATE), leaf(X.to(dtype))
    y = layer(x)
    y.backward()
    assert y.dtype == x.grad.dtype == dtype
    assert torch.func.hessian(layer)(X.to(dtype)).dtype == dtype
    with torch.no_grad():
        assert layer(x).dtype == dtype
    close(x.grad, estimate(layer.call.fn, X.to(dtype), AGGREGATE).gradient)


@BOTH
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    seen: list[torch.dtype] = []

    def fn(z: Tensor) -> Tensor:
        seen.append(z.dtype)
        return SCALAR.f(z.double()).float()

    layer, x = BlackBox(fn, AGGREGATE), leaf(BATCH.to(dtype))
    e = estimate(fn, x.detach().float(), AGGREGATE)
    y = layer(x)
    y.sum().backward()
    close(y.detach(), e.value.to(dtype))
    close(x.grad, e.gradient.to(dtype))
    close(estimate(fn, x, AGGREGATE).hessian(), e.hessian().to(dtype))
    close(torch.func.vmap(torch.func.grad(layer))(x.detach()), e.gradient.to(dtype))
    close(layer.freeze(x)(x.detach()), e.value.to(dtype))
    with torch.no_grad():
        close(layer(x), e.value.to(dtype))
    assert set(seen) == {torch.float32}


def test_a_layer_behind_autocast() -> None:
    model, inputs = nn.Linear(2, N), spread(8, -1.0, 1.0).view(4, 2).float()
    with torch.autocast("cpu", torch.bfloat16):
        z = model(inputs)
        y = BlackBox(SCALAR.f, AGGREGATE)(z)
    assert y.dtype == z.dtype == torch.bfloat16
    (gradient,) = torch.autograd.grad(y.sum(), z)
    close(gradient, estimate(SCALAR.f, z.detach().float(), AGGREGATE).gradient.bfloat16())


COMPILED = {
    "aggregate": AGGREGATE,
    "optimal": SETTINGS["optimal"],
    "sobol": SETTINGS["sobol"],
    "fr22": AGGREGATE.replace(proposal="fr22"),
    "auto": SETTINGS["auto"],
    "auto, random": Smoothing.auto(sigma=AGGREGATE.sigma, samples=3, seed=12),
}


@pytest.fixture(autouse=True)
def fresh_compiler() -> None:
    torch.compiler.reset()


@pytest.mark.parametrize("value", ["center", "smoothed"])
@pytest.mark.parametrize("smoothing", COMPILED.values(), ids=COMPILED.keys())
def test_compiled(smoothing: Smoothing, value: str) -> None:
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


@BOTH
def test_a_forward_pass_makes_no_pass_over_the_samples_and_a_gradient_makes_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    passes: list[str] = []
    for name in ("project", "accumulate"):
        original = getattr(kernels, name)
        monkeypatch.setattr(kernels, name, lambda *a, o=original, n=name: passes.append(n) or o(*a))
    x = leaf()
    y = BlackBox(SCALAR.f, AGGREGATE)(x)
    assert passes == []  # the perturbation of x is zero there, and so is its projection
    y.backward()
    assert passes == ["accumulate"]


@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_compiled_inside_a_network(backend: str) -> None:
    model, inputs = network(BlackBox(IMAGE.f, AGGREGATE))
    model(inputs).square().sum().backward()
    expected = [p.grad.clone() for p in model.parameters()]
    model.zero_grad()
    torch.compile(model, fullgraph=True, backend=backend)(inputs).square().sum().backward()
    for p, gradient in zip(model.parameters(), expected, strict=True):
        close(p.grad, gradient)


@pytest.mark.parametrize("by", ["backward", "grad"])
@pytest.mark.parametrize("smoothing", COMPILED.values(), ids=COMPILED.keys())
def test_double_backward_of_a_compiled_layer_is_an_error(smoothing: Smoothing, by: str) -> None:
    x = leaf()
    y = torch.compile(BlackBox(SCALAR.f, smoothing), fullgraph=True, backend="aot_eager")(x)
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
            arguments = (layer._handle, 12, keep, BATCH, [])
            torch.library.opcheck(ops.evaluate.default, arguments, test_utils=tests)
    torch.library.opcheck(ops.evaluate_center.default, (layer._handle, BATCH, []), test_utils=tests)


def module_level(z: Tensor) -> Tensor:
    return SCALAR.f(z)


def test_state_dict_resumes_the_settings() -> None:
    annealed = AGGREGATE.replace(sigma=0.0123, samples=4)
    source = nn.Sequential(nn.Linear(2, N), BlackBox(module_level, annealed)).double()
    buffer = io.BytesIO()
    torch.save(source.state_dict(), buffer)
    buffer.seek(0)
    for state in (source.state_dict(), torch.load(buffer)):
        target = nn.Sequential(nn.Linear(2, N), BlackBox(module_level, AGGREGATE)).double()
        target.load_state_dict(state)
        assert (target[1].smoothing.sigma, target[1].smoothing.samples) == (0.0123, 4)
        results = []
        for model in (source, target):
            model.zero_grad()
            model(vector(0.3, 0.4)).backward()
            results.append(model[0].weight.grad)
        assert torch.equal(*results)


def test_copies_and_pickles_live_on_their_own() -> None:
    layer = BlackBox(module_level, AGGREGATE)
    for other in (copy.deepcopy(layer), pickle.loads(pickle.dumps(layer)), copy.copy(layer)):
        other.smoothing = AGGREGATE.replace(sigma=0.2)
        assert layer.smoothing is AGGREGATE
        # A transform finds the layer by number: each must find its own settings.
        for one in (layer, other):
            close(torch.func.grad(one)(X), estimate(SCALAR.f, X, one.smoothing).gradient)
            close(torch.func.hessian(one)(X), estimate(SCALAR.f, X, one.smoothing).hessian())


def test_seed() -> None:
    free, fixed = BlackBox(SCALAR.f, AGGREGATE.replace(seed=None)), BlackBox(SCALAR.f, AGGREGATE)

    def gradients(layer: nn.Module, seed: int) -> list[Tensor]:
        torch.manual_seed(seed)
        return [torch.func.grad(layer)(X), torch.func.grad(layer)(X)]

    first, second = gradients(free, 0), gradients(free, 0)
    assert torch.equal(first[0], second[0])
    assert torch.equal(first[1], second[1])
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(first[0], gradients(free, 1)[0])
    same = gradients(fixed, 0) + gradients(fixed, 1)
    assert all(torch.equal(one, same[0]) for one in same)
    torch.manual_seed(5)
    state = torch.get_rng_state()
    gradients(fixed, 5)
    assert torch.equal(torch.get_rng_state(), state)


@pytest.mark.parametrize("outputs", [1, 20])
@pytest.mark.parametrize(
    ("sampler", "samples", "stored"),
    [("random", 200, True), ("random", 200, False), ("sobol", 200, True), ("orthogonal", 40, True)],
)
def test_any_number_of_threads_gives_the_same_bits(
    sampler: str, samples: int, stored: bool, outputs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    if not stored:
        monkeypatch.setattr(perturbations, "STORED", 0)
    n = 500
    smoothing, scale = Smoothing(sigma=0.5, samples=samples, sampler=sampler, seed=3), spread(outputs, 0.5, 2.0)

    def fn(z: Tensor) -> Tensor:  # a black box whose own bits do not follow the threads
        return (z[:, 0] + 0.5 * z[:, 99] - z[:, 300]).sin()[:, None] * scale

    def derivatives(threads: int) -> list[Tensor]:
        torch.set_num_threads(threads)
        x = leaf(spread(2 * n, -0.5, 0.5).view(2, n))
        y = BlackBox(fn, smoothing, value="smoothed")(x)
        (g,) = torch.autograd.grad(y, x, torch.ones_like(y), create_graph=True)
        (h,) = torch.autograd.grad(g, x, torch.ones_like(g))
        e = estimate(fn, x, smoothing, value="smoothed")
        results = [y.detach(), g.detach(), h, e.value, e.gradient, e.hvp(torch.ones(n)), e.standard_error("gradient")]
        return [*results, e.hessian_diagonal(), *([e.hessian()] if outputs == 1 else [])]

    before = torch.get_num_threads()
    try:
        pairs = zip(derivatives(1), derivatives(2), strict=True)
        assert not [number for number, (one, two) in enumerate(pairs) if not torch.equal(one, two)]
    finally:
        torch.set_num_threads(before)
