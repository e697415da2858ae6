"""A layer with sparse Jacobians: against the exact Jacobian of a blurred image, and against the dense layer."""

import math
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from layers import counting
from torch import nn

import torch_zerohess as zh
from torch_zerohess.autograd import sparse_layer
from torch_zerohess.evaluators.inline import Inline
from truths import normal

SIDE, N = 12, 144
SMOOTHING = zh.Smoothing(sigma=0.1, samples=64, seed=0)


def blurred(z):
    """[K, 144] -> [K, 10, 10]: each pixel is the mean of the tanh of 3x3 texels."""
    return nn.functional.avg_pool2d(z.tanh().view(-1, SIDE, SIDE), 3, 1)


X, TARGET = normal(3, N), normal(3, 10, 10, seed=1)


def exact(x):
    return torch.stack([torch.func.jacrev(lambda z: blurred(z[None])[0])(one) for one in x]).flatten(1, 2)


def gradient_and_product(layer, v):
    """Of half of the squared distance of the outputs from a target: J^T r, and its derivative along v."""
    x = X.clone().requires_grad_()
    (slope,) = torch.autograd.grad(0.5 * (layer(x) - TARGET).square().sum(), x, create_graph=True)
    (product,) = torch.autograd.grad((slope * v).sum(), x)
    return slope.detach(), product


def relative(one, other):
    return float((one - other).norm() / other.norm())


def test_gradient_and_gauss_newton_product():
    """The noise of the dense layer, with as many evaluations, is a hundred times as large."""
    v, jacobian = normal(3, N, seed=2), exact(X)
    slope = torch.einsum("bmn,bm->bn", jacobian, (blurred(X) - TARGET).flatten(1))
    product = torch.einsum("bmn,bm->bn", jacobian, torch.einsum("bmn,bn->bm", jacobian, v))
    found = gradient_and_product(zh.SparseBlackBox(blurred, SMOOTHING), v)
    assert relative(found[0], slope) < 0.05
    assert relative(found[1], product) < 0.05
    dense = gradient_and_product(zh.BlackBox(blurred, SMOOTHING), v)
    assert relative(dense[0], slope) > 0.5
    assert relative(dense[1], product) > 5.0


def test_points_one_at_a_time_where_the_evaluator_says():
    class Counting:
        calls = 0

        def __call__(self, fn, points, *aux):
            self.calls += 1
            return Inline()(fn, points, *aux)

    def one(z):
        assert z.shape == (N,)
        return blurred(z[None])[0]

    whole, evaluator = zh.SparseBlackBox(blurred, SMOOTHING), Counting()
    single = zh.SparseBlackBox(one, SMOOTHING, vectorized=False, evaluator=evaluator)
    v = normal(3, N, seed=2)
    for found, expected in zip(*(gradient_and_product(layer, v) for layer in (single, whole)), strict=True):
        torch.testing.assert_close(found, expected)
    assert evaluator.calls == 4  # the values, and the samples around each of three points


def test_samples_without_a_value():
    v = normal(3, N, seed=2)

    def holes(z):
        outputs = blurred(z).clone()
        if len(z) > len(X):  # samples, not the points themselves
            outputs[7] = math.nan
        return outputs

    with pytest.raises(ValueError, match="choose on_nonfinite"):
        gradient_and_product(zh.SparseBlackBox(holes, SMOOTHING), v)
    slope, _ = gradient_and_product(zh.SparseBlackBox(holes, SMOOTHING, on_nonfinite="drop"), v)
    assert relative(slope, gradient_and_product(zh.SparseBlackBox(blurred, SMOOTHING), v)[0]) < 0.05
    with pytest.warns(UserWarning, match=r"explained = 0\.00"):
        slope, _ = gradient_and_product(zh.SparseBlackBox(holes, SMOOTHING, on_nonfinite=1e3), v)
    assert relative(slope, gradient_and_product(zh.SparseBlackBox(blurred, SMOOTHING), v)[0]) > 0.5


def test_second_derivatives_of_first_ones_in_a_batch():
    """`is_grads_batched` maps in an older way than `torch.func`, which takes the graph from functions."""
    layer, x, v = zh.SparseBlackBox(blurred, SMOOTHING), X.clone().requires_grad_(), normal(2, 3, 10, 10, seed=2)
    y = layer(x.sin()).exp()
    each = [torch.autograd.grad(y, x, one, create_graph=True)[0] for one in v]
    (rows,) = torch.autograd.grad(y, x, v, create_graph=True, is_grads_batched=True)
    torch.testing.assert_close(rows, torch.stack(each))
    expected, found = (
        torch.autograd.grad(one.square().sum(), x, retain_graph=True)[0] for one in (torch.stack(each), rows)
    )
    torch.testing.assert_close(found, expected)


def test_the_layer_is_linear_around_the_point_of_the_call():
    layer, v = zh.SparseBlackBox(blurred, SMOOTHING), normal(3, N, seed=2)
    slope, product = gradient_and_product(layer, v)
    jacobian = torch.stack([one.dense() for one in layer.jacobians]).flatten(1, 2)
    residual = (blurred(X) - TARGET).flatten(1)
    torch.testing.assert_close(slope, torch.einsum("bmn,bm->bn", jacobian, residual))
    along = torch.einsum("bmn,bn->bm", jacobian, v)
    torch.testing.assert_close(product, torch.einsum("bmn,bm->bn", jacobian, along))


def test_a_network_learns_through_it():
    """Newton steps with few samples: the support is kept from call to call."""
    torch.manual_seed(0)
    network, inputs = nn.Linear(5, N).double(), normal(4, 5)
    wanted = blurred(nn.Linear(5, N).double()(inputs)).detach()
    layer = zh.SparseBlackBox(blurred, zh.Smoothing(sigma=0.1, samples=30, seed=0), grid=(SIDE, SIDE))
    settings = {"solver": "dual", "modification": "abs", "damping": 1e-3, "adapt": False}
    optimizer = zh.optim.NewtonCG(network.parameters(), radius=1.0, curvature="gauss_newton", **settings)
    losses = [float(optimizer.step(lambda: (layer(network(inputs)) - wanted).square().mean())) for _ in range(8)]
    assert losses[-1] < 0.02 * losses[0]


def test_evaluations_and_what_is_evaluated_without_derivatives():
    counted, calls = counting(blurred)
    layer = zh.SparseBlackBox(counted, SMOOTHING)
    layer(X.clone().requires_grad_())
    assert calls == [3, 128, 128, 128]
    calls.clear()
    with torch.no_grad():
        layer(X.clone().requires_grad_())
    layer(X)
    assert calls == [3, 3]


@pytest.mark.parametrize("batch", [(), (2,), (2, 1)])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shapes_and_types(batch, dtype):
    x = normal(*batch, N).to(dtype).requires_grad_()
    y = zh.SparseBlackBox(blurred, SMOOTHING)(x)
    assert y.shape == (*batch, 10, 10)
    assert y.dtype == dtype
    torch.testing.assert_close(y.detach(), blurred(x.detach().reshape(-1, N)).view_as(y))
    y.sum().backward()
    assert x.grad.shape == x.shape


def test_an_empty_batch_after_another_one():
    layer, x = zh.SparseBlackBox(blurred, SMOOTHING), torch.zeros(0, N, requires_grad=True)
    with pytest.raises(ValueError, match="every batch dimension > 0"):
        layer(x)
    layer(normal(1, N).requires_grad_())
    y = layer(x)
    y.sum().backward()
    assert (y.shape, x.grad.shape) == ((0, 10, 10), (0, N))


def test_another_shape_of_the_output_starts_afresh():
    shown = {"rows": 10}
    layer = zh.SparseBlackBox(lambda z: blurred(z)[:, : shown["rows"]], SMOOTHING)
    x = normal(1, N).requires_grad_()
    layer(x).sum().backward()
    shown["rows"] = 6
    fresh = zh.SparseBlackBox(layer.call.fn, SMOOTHING)
    (found,) = torch.autograd.grad(layer(x).sum(), x)
    (expected,) = torch.autograd.grad(fresh(x).sum(), x)
    assert torch.equal(found, expected)
    assert layer.jacobians[0].shape == (6, 10)


def test_one_seed_gives_the_same_bits_and_every_element_its_own_noise():
    x, seen = X[:1].repeat(2, 1).requires_grad_(), []

    def seeing(z):
        seen.append(z)
        return blurred(z)

    first, second = (torch.autograd.grad(zh.SparseBlackBox(seeing, SMOOTHING)(x).sum(), x)[0] for _ in range(2))
    assert torch.equal(first, second)
    assert [len(z) for z in seen] == [2, 128, 128] * 2
    assert torch.equal(seen[1], seen[4])
    assert not torch.equal(seen[1], seen[2])


def test_with_a_fixed_seed_errors_are_of_samples_that_earlier_calls_have_not_seen():
    """80 outputs of 4 of 200 parameters, as rough as a renderer with fixed noise.

    Of 220 to 250 slopes 93 to 99 % are within 1.96 standard errors. If samples are drawn again, 85 % are, and errors
    stay the same.
    """
    A = normal(80, 200) * (normal(80, 200, seed=1).abs().argsort(1).argsort(1) < 4)

    def rough(z):
        return z @ A.mT + 0.1 * torch.sin(1e5 * (z @ A.mT))

    def change(u):
        return 0.5 * (rough(u) - rough(-u))

    u, x = 0.1 * normal(2000, 200, seed=2), torch.zeros(1, 200, dtype=torch.float64, requires_grad=True)
    layer = zh.SparseBlackBox(rough, zh.Smoothing(sigma=0.1, samples=60, seed=0))
    errors = []
    for _ in range(4):
        layer(x)
        (J,) = layer.jacobians
        truth = A.gather(1, J.index)
        scores = ((J.values - truth) / J.standard_error)[J.found & (truth != 0)]
        assert float((scores.abs() < 1.96).double().mean()) > 0.9
        rest = change(u) - J.matvec(u)
        assert J.explained < 1.01 - float(rest.square().sum() / change(u).square().sum())
        errors.append(relative(J.dense(), A))
    assert errors[-1] < 0.8 * errors[0]
    assert J.total_evaluations == 4 * J.evaluations == 480


def test_what_earlier_calls_have_found_helps_later_ones():
    jacobian = exact(X[:1])
    layer = zh.SparseBlackBox(blurred, zh.Smoothing(sigma=0.1, samples=24, seed=0), grid=(SIDE, SIDE))
    errors = []
    for seed in range(4):
        layer.smoothing = layer.smoothing.replace(seed=seed)
        layer(X[:1].clone().requires_grad_())
        errors.append(relative(layer.jacobians[0].dense().flatten(0, 1), jacobian[0]))
    assert errors[-1] < 0.5 * errors[0]


def test_sigma_is_annealed_and_saved():
    layer, other = (zh.SparseBlackBox(blurred, SMOOTHING) for _ in range(2))
    schedule = zh.LinearSigma(nn.Sequential(nn.Flatten(), layer), 0.4, 0.2, steps=2)
    schedule.step()
    assert layer.smoothing.sigma == pytest.approx(0.3)
    other.load_state_dict(layer.state_dict())
    assert other.smoothing == layer.smoothing


def test_what_it_refuses():
    x = X.clone().requires_grad_()
    layer = zh.SparseBlackBox(blurred, SMOOTHING)
    for smoothing in (SMOOTHING, SMOOTHING.replace(samples=1)):  # also where there are too few samples
        with pytest.raises(ValueError, match="for one number use BlackBox"):
            zh.SparseBlackBox(lambda z: z.sum(1), smoothing)(x)
    with pytest.raises(ValueError, match="sampler must be 'random', 'orthogonal' or 'auto', got 'sobol'"):
        zh.SparseBlackBox(blurred, SMOOTHING.replace(sampler="sobol"))(x)
    with pytest.raises(RuntimeError, match="use BlackBox"):
        torch.func.grad(lambda z: layer(z).sum())(X)
    with pytest.raises(RuntimeError, match="use BlackBox"):
        torch.func.vmap(layer)(X)
    with pytest.raises(ValueError, match="grid"):
        zh.SparseBlackBox(blurred, SMOOTHING, grid=(3, 3))(x)
    with pytest.raises(ValueError, match="fn returned nan at the point"):
        zh.SparseBlackBox(lambda z: blurred(z) * math.nan, SMOOTHING)(x)
    with pytest.raises(TypeError, match="smoothing must be a Smoothing"):
        zh.SparseBlackBox(blurred, 0.1)
    with pytest.raises(ValueError, match="rate must be positive and below 1, got 0"):
        zh.SparseBlackBox(blurred, SMOOTHING, rate=0.0)
    with pytest.raises(TypeError, match="grid must be rows and columns"):
        zh.SparseBlackBox(blurred, SMOOTHING, grid="abc")


@pytest.mark.filterwarnings("ignore:`torch.jit:FutureWarning")
def test_torch_jit_is_refused():
    with pytest.raises(RuntimeError, match="is not compiled"):
        torch.jit.trace(zh.SparseBlackBox(lambda z: z.numpy(), SMOOTHING), X)


def test_calls_of_several_threads_do_not_take_each_others_jacobians(monkeypatch):
    """The slope of output k by x_k is x_0, another number in every thread. Both are known before either is used."""
    together = threading.Barrier(2)

    class Waiting:
        @staticmethod
        def apply(x):
            together.wait(60.0)
            return x

    monkeypatch.setattr(sparse_layer, "Input", Waiting)
    layer = zh.SparseBlackBox(lambda z: z[:, :1] * z[:, 1:], zh.Smoothing(sigma=1e-3, samples=40), keep=2)

    def slope(size):
        x = torch.full((1, 33), size, dtype=torch.float64, requires_grad=True)
        layer(x).sum().backward()
        return float(x.grad[0, 1:].mean()) / size

    with ThreadPoolExecutor(2) as threads:
        slopes = list(threads.map(slope, [1.0, 10.0]))
    assert slopes == pytest.approx([1.0, 1.0], rel=0.1)


def test_autocast_does_not_reach_the_fit():
    def gradient(*, autocast):
        layer, x = zh.SparseBlackBox(blurred, SMOOTHING, grid=(SIDE, SIDE)), X.float().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            y = layer(x)
        return torch.autograd.grad((y - TARGET).square().sum(), x)[0]

    assert torch.equal(gradient(autocast=True), gradient(autocast=False))


def test_a_dense_black_box_is_a_warning_once_in_a_layer():
    """Every output depends on each of 200 parameters: no entry is found, and the gradient is zero."""
    W = normal(50, 200)
    layer = zh.SparseBlackBox(lambda z: z @ W.T, zh.Smoothing(sigma=0.1, samples=40, seed=0))
    x = torch.zeros(2, 200, dtype=torch.float64, requires_grad=True)
    with pytest.warns(UserWarning, match=r"explained = 0\.00 of the changes.* 40, or BlackBox"):
        layer(x)
    layer(x)  # a second warning is an error
