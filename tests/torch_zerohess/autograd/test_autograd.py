"""The layer under every transform of torch: its derivatives equal `estimate` with the same seed, to rounding."""

import pytest
import torch
from layers import AGGREGATE, BATCH, BOTH, EVERY, IMAGE, SCALAR, SETTINGS, N, V, X, close, leaf, network
from torch import Tensor
from torch.autograd import forward_ad, gradcheck, gradgradcheck

import torch_zerohess as zh
from torch_zerohess import BlackBox, Smoothing, estimate, smooth
from torch_zerohess.autograd import tracing
from torch_zerohess.estimation import perturbations
from torch_zerohess.sampling import kernels
from truths import spread, vector


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
@pytest.mark.parametrize("form", ["layer", "frozen"])
def test_second_derivatives_of_first_ones_in_a_batch(smoothing: Smoothing, form: str) -> None:
    """`is_grads_batched` maps in an older way than `torch.func`, which takes the graph from functions."""
    e, x, layer = estimate(IMAGE.f, X, smoothing), leaf(), BlackBox(IMAGE.f, smoothing)
    f = layer if form == "layer" else layer.freeze(X)
    rows = torch.autograd.functional.jacobian(f, x, create_graph=True, vectorize=True)
    close(rows.detach(), e.gradient)
    second = [torch.autograd.grad(one, x, retain_graph=True)[0] for one in rows.flatten()]
    close(torch.stack(second).view(2, 2, N, N), e.hessian())


@BOTH
def test_a_penalty_of_a_jacobian_in_one_batch() -> None:
    layer, target = BlackBox(IMAGE.f, AGGREGATE, head=zh.heads.SquaredError()), torch.zeros(4, 2, 2, dtype=X.dtype)
    slopes = []
    for vectorize in (False, True):
        x = leaf(BATCH)
        rows = torch.autograd.functional.jacobian(
            lambda z: layer(z.sin(), target), x, create_graph=True, vectorize=vectorize
        )
        slopes.append(torch.autograd.grad(rows.square().sum(), x)[0])
    close(slopes[1], slopes[0])


@BOTH
def test_third_derivatives_of_second_ones_in_a_batch() -> None:
    slopes = []
    for vectorize in (False, True):
        x, f = leaf(), smooth(SCALAR.f, AGGREGATE)
        hessian = torch.autograd.functional.hessian(f, x, create_graph=True, vectorize=vectorize)
        slopes.append(torch.autograd.grad(hessian.square().sum(), x)[0])
    close(slopes[1], slopes[0])


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
        if tracing.GRAPHS:
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
@pytest.mark.parametrize(
    ("memory", "name"), [*(("stored", name) for name in SETTINGS), ("redrawn", "sobol")], indirect=["memory"]
)
def test_frozen_samples_pass_gradcheck_in_every_mode(name: str) -> None:
    smoothing = SETTINGS[name]
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
