"""Grey-box curvature against `torch.func.hessian` of the same network with the analytic smoothed function behind it.

The samples are many and quasi-random, so that their error is far below the tolerances, which are
relative to the largest element; the structure (symmetry, agreement of matrix-free and dense) holds to rounding.
"""

from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import nn
from torch.func import functional_call

import torch_zerohess as zh
from truths import Bump, ClosedForm, PlaneWave, Quadratic

SIGMA = 0.5
TRUTHS = {
    "plane wave": PlaneWave(torch.tensor([0.9, -0.7, 1.1], dtype=torch.float64)),
    "bump": Bump(1.3),
    "quadratic": Quadratic(
        torch.diag(torch.tensor([1.0, 2.0, 0.5], dtype=torch.float64)) + 0.2, torch.ones(3, dtype=torch.float64)
    ),
}


def smoothed(truth: ClosedForm, y: torch.Tensor) -> torch.Tensor:
    """Closed form of a batch y [B, n]."""
    sigma = torch.full((y.shape[-1],), SIGMA, dtype=torch.float64)
    return torch.func.vmap(lambda one: truth.smoothed(one, sigma))(y)


def network() -> nn.Module:
    torch.manual_seed(0)
    return nn.Sequential(nn.Linear(4, 5), nn.Tanh(), nn.Linear(5, 3)).double()


def flat_call(net: nn.Module, theta: torch.Tensor, inputs: torch.Tensor) -> torch.Tensor:
    parts = theta.split([p.numel() for p in net.parameters()])
    named = {n: part.view_as(p) for (n, p), part in zip(net.named_parameters(), parts, strict=True)}
    return functional_call(net, named, (inputs,))


class Case(NamedTuple):
    """A loss behind two white boxes and a black one, its parameters, and by mode its curvature: true and found."""

    loss: torch.Tensor
    parameters: list[nn.Parameter]
    truth: dict[str, torch.Tensor]
    dense: dict[str, torch.Tensor]


@pytest.fixture(scope="module", params=TRUTHS)
def case(request):
    truth, net = TRUTHS[request.param], network()
    inputs = torch.randn(6, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    theta = torch.cat([p.detach().flatten() for p in net.parameters()])
    hessian = torch.func.hessian(lambda t: smoothed(truth, flat_call(net, t, inputs)).square().mean())(theta)
    y = net(inputs).detach().flatten()
    inner = torch.func.hessian(lambda z: smoothed(truth, z.view(6, 3)).square().mean())(y)
    jacobian = torch.func.jacrev(lambda t: flat_call(net, t, inputs).flatten())(theta)
    layer = zh.BlackBox(truth.f, zh.Smoothing(sigma=SIGMA, samples=1 << 14, sampler="sobol", seed=0), value="smoothed")
    loss = layer(net(inputs)).square().mean()  # white box, black box, white box
    parameters, expected = list(net.parameters()), {"exact": hessian, "gauss_newton": jacobian.mT @ inner @ jacobian}
    dense = {mode: zh.CurvatureOperator(loss, parameters, mode=mode).to_dense() for mode in expected}
    return Case(loss, parameters, expected, dense)


@pytest.mark.parametrize("mode", ["exact", "gauss_newton"])
def test_dense_matches_torch_func(case, mode):
    dense, truth = case.dense[mode], case.truth
    assert (dense - truth[mode]).abs().max() < 5e-3 * truth[mode].abs().max()
    torch.testing.assert_close(dense, dense.mT, rtol=0, atol=1e-12 * float(dense.abs().max()))


def test_modes_differ_by_the_curvature_of_the_network(case):
    truth, difference = case.truth, case.dense["exact"] - case.dense["gauss_newton"]
    expected = truth["exact"] - truth["gauss_newton"]
    assert expected.abs().max() > 1e-2 * truth["exact"].abs().max()
    assert (difference - expected).abs().max() < 5e-3 * truth["exact"].abs().max()


@pytest.mark.parametrize("mode", ["exact", "gauss_newton"])
def test_products_match_the_dense_matrix(case, mode):
    loss, parameters, _, every = case
    operator, dense = zh.CurvatureOperator(loss, parameters, mode=mode), every[mode]
    block = torch.randn(operator.shape[0], 3, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(operator @ block, dense @ block)
    torch.testing.assert_close(operator @ block[:, 0], dense @ block[:, 0])
    gradient = torch.cat([g.flatten() for g in torch.autograd.grad(loss, parameters, retain_graph=True)])
    torch.testing.assert_close(operator.gradient, gradient)
    vectors = [
        part.view_as(p) for part, p in zip(block[:, 0].split([p.numel() for p in parameters]), parameters, strict=True)
    ]
    product = zh.hvp(loss, parameters, vectors, mode=mode)
    torch.testing.assert_close(torch.cat([one.flatten() for one in product]), dense @ block[:, 0])
    if mode == "gauss_newton":
        product = zh.hvp(loss, parameters, vectors, mode=mode, through=operator.through)
        torch.testing.assert_close(torch.cat([one.flatten() for one in product]), dense @ block[:, 0])


@pytest.mark.parametrize("mode", ["exact", "gauss_newton"])
def test_matrix_free_at_the_size_of_the_cnn(mode):
    """267 745 weights: H v against double differentiation of the closed form, on the same float64 network."""
    from experiments.problems.tasks import cnn

    torch.manual_seed(0)
    encoder = cnn.Rotation(cnn.SIZES["fast"]).encoder().double()
    parameters = list(encoder.parameters())
    assert sum(p.numel() for p in parameters) == 267_745
    images = torch.rand(2, 3, 64, 64, dtype=torch.float64)
    wave = PlaneWave(torch.tensor([0.8], dtype=torch.float64))
    v = [torch.randn_like(p) for p in parameters]
    y = encoder(images)
    smooth = smoothed(wave, y).mean()
    if mode == "exact":
        slopes = torch.autograd.grad(smooth, parameters, create_graph=True)
        expected = torch.autograd.grad(slopes, parameters, v)
    else:
        names = [name for name, _ in encoder.named_parameters()]
        values = dict(zip(names, (p.detach() for p in parameters), strict=True))
        along = dict(zip(names, v, strict=True))
        step = torch.func.jvp(lambda p: functional_call(encoder, p, (images,)), (values,), (along,))[1]
        bend = torch.func.hessian(lambda z: smoothed(wave, z).mean())(y.detach())
        pushed = torch.einsum("aibj,bj->ai", bend, step)
        expected = torch.autograd.grad(y, parameters, pushed)
    layer = zh.BlackBox(wave.f, zh.Smoothing(sigma=SIGMA, samples=1 << 13, sampler="sobol", seed=0))
    found = zh.hvp(layer(encoder(images)).mean(), parameters, v, mode=mode)
    scale = max(float(one.abs().max()) for one in expected)
    worst = max(float((a - b).abs().max()) for a, b in zip(found, expected, strict=True))
    assert worst < 5e-3 * scale


def test_two_black_boxes_side_by_side():
    net, inputs = network(), torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    wave = TRUTHS["plane wave"]
    smoothing = zh.Smoothing(sigma=SIGMA, samples=64, seed=0)
    layers = [zh.BlackBox(wave.f, smoothing), zh.BlackBox(lambda z: wave.f(2 * z), smoothing)]
    y = net(inputs)
    losses = [layers[0](y).mean(), layers[1](y).sum()]
    parts = [zh.CurvatureOperator(one, list(net.parameters()), mode="gauss_newton").to_dense() for one in losses]
    both = zh.CurvatureOperator(sum(losses), list(net.parameters()), mode="gauss_newton").to_dense()
    torch.testing.assert_close(both, parts[0] + parts[1])


def test_through_names_where_the_white_box_ends():
    net, inputs = network(), torch.randn(3, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(3))
    y = net(inputs)
    loss = (y**4).sum()
    found = zh.CurvatureOperator(loss, list(net.parameters()), mode="gauss_newton", through=y).to_dense()
    theta = torch.cat([p.detach().flatten() for p in net.parameters()])
    jacobian = torch.func.jacrev(lambda t: flat_call(net, t, inputs).flatten())(theta)
    torch.testing.assert_close(found, jacobian.mT @ torch.diag(12 * y.detach().flatten() ** 2) @ jacobian)


def test_errors_name_what_is_wrong():
    x = torch.ones(2, requires_grad=True)
    layer = zh.BlackBox(lambda z: z.sum(1), zh.Smoothing(sigma=1.0))
    chained = layer(x) * torch.ones(2)
    cases = [
        (lambda: zh.CurvatureOperator(x.detach().sum(), x), "no graph"),
        (lambda: zh.CurvatureOperator(x * 2, x), r"shape \[2\]"),
        (lambda: zh.CurvatureOperator(x.sum(), x, mode="newton"), "mode must be"),
        (lambda: zh.CurvatureOperator(x.sum(), x, mode="gauss_newton"), "found no BlackBox"),
        (lambda: zh.CurvatureOperator(layer(chained), x, mode="gauss_newton"), "side by side"),
        (lambda: zh.CurvatureOperator(x.sum(), x) @ torch.ones(3), r"\[3\]"),
        (lambda: zh.CurvatureOperator(x.sum(), x, through=x), "through"),
        (lambda: zh.CurvatureOperator(x.sum(), x, mode="gauss_newton", through=[]), "through must have at least one"),
        (lambda: zh.hvp(x.sum(), x, torch.ones(3)), "shapes of inputs"),
    ]
    for make, message in cases:
        with pytest.raises(ValueError, match=message):
            make()


def test_a_dense_matrix_beyond_ten_thousand_parameters_is_refused():
    x = torch.zeros(10_001, requires_grad=True)
    operator = zh.CurvatureOperator((x**2).sum(), x)
    with pytest.raises(ValueError, match="matrix of 10001 squared numbers: use H @ v"):
        operator.to_dense()
    torch.testing.assert_close(operator @ torch.ones(10_001), torch.full((10_001,), 2.0))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_arrays_of_numpy_give_arrays_of_their_type(dtype):
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    operator = zh.CurvatureOperator((x**3).sum(), x)
    v, both = np.array([1.0, -1.0], dtype=dtype), np.eye(2, dtype=dtype)
    for got, expected in ((operator @ v, [6.0, -12.0]), (operator @ both, [[6.0, 0.0], [0.0, 12.0]])):
        assert got.dtype == dtype
        np.testing.assert_allclose(got, expected, rtol=1e-6)


def test_a_list_of_vectors_is_refused():
    x = torch.ones(2, requires_grad=True)
    with pytest.raises(TypeError, match=r"v must be a tensor \[2\], all inputs in one, got list"):
        zh.CurvatureOperator((x**2).sum(), x) @ [torch.ones(2)]


@pytest.mark.parametrize("mode", ["exact", "gauss_newton"])
def test_parameters_that_the_loss_does_not_depend_on_have_no_curvature(mode):
    used, linear, unused = (torch.tensor([1.0, 2.0], requires_grad=True) for _ in range(3))
    loss = (used**2).sum() + linear.sum()
    through = [used, linear] if mode == "gauss_newton" else None
    operator = zh.CurvatureOperator(loss, [used, linear, unused], mode=mode, through=through)
    assert operator.gradient.tolist() == [2.0, 4.0, 1.0, 1.0, 0.0, 0.0]
    assert torch.equal(operator.to_dense(), torch.diag(torch.tensor([2.0, 2.0, 0.0, 0.0, 0.0, 0.0])))
    alone = zh.CurvatureOperator(linear.sum(), linear)  # its gradient has no graph at all
    assert torch.equal(alone.to_dense(), torch.zeros(2, 2))


@pytest.mark.parametrize("through", ["a second pass", "a copy", "a new leaf"])
def test_a_loss_that_is_not_computed_from_through_is_refused(through):
    """Its curvature would be zero."""
    net, x = torch.nn.Linear(3, 2), torch.ones(4, 3)
    y = net(x)
    other = {"a second pass": net(x), "a copy": y.clone(), "a new leaf": y.detach().requires_grad_()}[through]
    for index, ends in enumerate((other, [y, other])):
        with pytest.raises(ValueError, match=rf"but through\[{index}\], \[4, 2\], is not on the path to the loss"):
            zh.CurvatureOperator(y.square().sum(), list(net.parameters()), mode="gauss_newton", through=ends)


def test_a_tensor_is_given_once():
    """Else its curvature would count more than once."""
    W = torch.ones(2, 3, requires_grad=True)
    y = torch.ones(4, 3) @ W.T
    for through in ([y, y], (y, W.sum(), y)):
        loss, last = y.square().sum() + W.sum() * y.sum(), len(through) - 1
        with pytest.raises(ValueError, match=rf"but through\[{last}\] is through\[0\] again"):
            zh.CurvatureOperator(loss + through[1].sum(), W, mode="gauss_newton", through=through)
    for call in (lambda: zh.CurvatureOperator(W.sum(), [W, W]), lambda: zh.hvp(W.sum(), [W, W], [W, W])):
        with pytest.raises(
            ValueError, match=r"inputs must have every tensor once, but inputs\[1\] is inputs\[0\] again"
        ):
            call()


@pytest.mark.parametrize("index", [0, 1])
def test_where_the_white_box_ends_no_tensor_is_computed_from_another(index):
    net = torch.nn.Linear(3, 2)
    y = net(torch.ones(4, 3))
    z = y.tanh()
    loss, through = y.square().sum() + z.square().sum(), [y, z] if index == 0 else [z, y]
    with pytest.raises(ValueError, match=rf"one of them is computed from through\[{index}\], \[4, 2\]"):
        zh.CurvatureOperator(loss, list(net.parameters()), mode="gauss_newton", through=through)


def test_the_white_box_may_end_at_several_results_of_one_operation():
    net = torch.nn.Linear(3, 2)
    y = net(torch.randn(4, 3, generator=torch.Generator().manual_seed(0)))
    left, right = y.unbind(1)
    loss = (left * right).square().sum()
    found = zh.CurvatureOperator(loss, list(net.parameters()), mode="gauss_newton", through=[left, right])
    one = zh.CurvatureOperator(loss, list(net.parameters()), mode="gauss_newton", through=y)
    torch.testing.assert_close(found.to_dense(), one.to_dense())


def test_an_end_of_the_white_box_that_does_not_require_grad_is_refused():
    w, c = torch.ones(3, requires_grad=True), torch.ones(3)
    y = 2 * w
    with pytest.raises(ValueError, match=r"but through\[1\], \[3\], is not on the path .* that do not require grad"):
        zh.CurvatureOperator((y * c).square().sum(), w, mode="gauss_newton", through=[y, c])


def test_what_is_no_tensor_is_refused():
    x = torch.tensor([1.0, 2.0], requires_grad=True)
    for call, message in (
        (lambda: zh.CurvatureOperator(3.0, x), "outputs must be the loss, a tensor, got float"),
        (lambda: zh.CurvatureOperator((x.sum(), x), x), "outputs must be the loss, a tensor, got tuple"),
        (lambda: zh.CurvatureOperator(x.sum(), 3.0), "inputs must be a tensor, got float"),
        (lambda: zh.CurvatureOperator(x.sum(), [x, 3.0]), "inputs must be a tensor, got float"),
        (lambda: zh.CurvatureOperator(x.sum(), x, mode="gauss_newton", through=3.0), "through must be a tensor, got"),
        (lambda: zh.hvp(x.sum(), x, 3.0), "v must be a tensor, got float"),
    ):
        with pytest.raises(TypeError, match=message):
            call()
    layers = torch.nn.Linear(2, 1)
    assert zh.CurvatureOperator(layers(x).sum(), layers.parameters()).shape == (3, 3)


@pytest.mark.parametrize("narrow", [torch.bfloat16, torch.float16, torch.float32])
@pytest.mark.parametrize("first", ["narrow", "wide"])
def test_parameters_of_different_types_keep_their_digits(narrow: torch.dtype, first: str) -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.ones(5, dtype=narrow, requires_grad=True)
    b, v, scale = (torch.rand(50, dtype=torch.float64, generator=generator) for _ in range(3))
    b.requires_grad_()
    parts = [(a, torch.ones_like(a)), (b, v)]
    inputs, vectors = zip(*(parts if first == "narrow" else parts[::-1]), strict=True)
    loss = (scale * b.square()).sum() + a.double().square().sum()
    products = zh.hvp(loss, inputs, vectors)
    torch.testing.assert_close(products[1 if first == "narrow" else 0], 2 * scale * v)
    torch.testing.assert_close(products[0 if first == "narrow" else 1], 2 * torch.ones(5, dtype=torch.float64))
    assert zh.CurvatureOperator(loss, inputs).dtype == torch.float64
