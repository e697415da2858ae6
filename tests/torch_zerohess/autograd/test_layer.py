"""What a layer costs, keeps and accepts: calls, passes, dtypes, state, copies, seeds and threads."""

import copy
import io
import math
import pickle
from collections.abc import Callable
from typing import Literal

import pytest
import torch
from layers import AGGREGATE, BATCH, BOTH, SCALAR, N, V, X, close, counting, leaf
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.utils.checkpoint import checkpoint

from torch_zerohess import BlackBox, Memory, Smoothing, SparseBlackBox, estimate, smooth
from torch_zerohess.autograd import transforms
from torch_zerohess.estimation import perturbations
from torch_zerohess.heads import SquaredError
from torch_zerohess.sampling import extension, kernels, stein_sums
from truths import deviation, normal, spread, vector


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


@pytest.mark.parametrize(("seeds", "unbiased"), [((1, 2), True), ((None, None), True), ((1, 1), False)])
def test_layers_in_sequence_need_different_perturbations(seeds: tuple[int | None, int | None], unbiased: bool) -> None:
    """E sin(x + sigma u) = exp(-sigma^2 / 2) sin(x), so the slope behind two layers is the product of two slopes.

    With the same perturbations it is too large by the covariance of the two Jacobians, here a third, which 4 000
    elements tell.
    """
    torch.manual_seed(0)
    sigma, n = 0.5, 3
    first, second = (BlackBox(torch.sin, Smoothing(sigma=sigma, seed=seed)) for seed in seeds)
    x = spread(n, -0.5, 0.5).expand(4000, n).requires_grad_()
    (slopes,) = torch.autograd.grad(second(first(x)).sum(), x)
    truth = math.exp(-(sigma**2)) * torch.cos(x[0]) * torch.cos(torch.sin(x[0]))
    assert (deviation(slopes, truth.detach()) < 5.0) == unbiased


@pytest.mark.parametrize(("value", "unbiased"), [("center", True), ("smoothed", False)])
def test_gradients_of_a_nonlinear_loss_behind_a_layer(value: Literal["center", "smoothed"], unbiased: bool) -> None:
    """Of y^2 behind a step f: 2 f(x) F'(x) and 2 F(x) F'(x), where F is the normal distribution.

    The smoothed value comes from the samples of the slope. With 8 samples the gradient is 3 % too low, which 20 000
    elements tell.
    """
    torch.manual_seed(0)
    sigma, at = 0.5, vector(0.3)
    x = at.expand(20_000, 1).clone().requires_grad_()
    layer = BlackBox(lambda z: (z[:, 0] > 0).double(), Smoothing(sigma=sigma), value=value)
    (slopes,) = torch.autograd.grad(layer(x).square().sum(), x)
    density = torch.exp(-0.5 * (at / sigma) ** 2) / math.sqrt(2.0 * math.pi) / sigma
    y = torch.special.ndtr(at / sigma) if value == "smoothed" else 1.0
    assert (deviation(slopes, 2.0 * y * density) < 5.0) == unbiased


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


@pytest.mark.parametrize("memory", [False, True])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_losses_of_a_head_stay_float32(dtype: torch.dtype, memory: bool) -> None:
    """As losses of torch do under autocast: the loss of an image exceeds 65504, and has digits that training needs."""
    x = leaf(BATCH.to(dtype))
    layer = BlackBox(
        lambda z: z.sum(1, keepdim=True) * torch.full((100,), 30.3),
        AGGREGATE,
        head=lambda y: y.square().sum(1),
        memory=Memory() if memory else None,
    )
    expected = (x.detach().float().sum(1) * 30.3).square() * 100
    with torch.no_grad():
        torch.testing.assert_close(layer(x), expected)
    for y in (layer(x), layer.freeze(x)(x)):
        torch.testing.assert_close(y.detach(), expected)
    assert torch.autograd.grad(layer(x).sum(), x)[0].dtype == dtype
    assert layer(x[:0]).dtype == torch.float32


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_auxiliary_inputs_in_half_precision_become_float32(dtype: torch.dtype) -> None:
    seen: set[torch.dtype] = set()

    def fn(z: Tensor, a: Tensor) -> Tensor:
        seen.add(a.dtype)
        return SCALAR.f(z) * torch.from_numpy(a.numpy())

    a, whole = torch.linspace(0.1, 0.7, 4).to(dtype), torch.arange(4)
    close(BlackBox(fn, AGGREGATE)(leaf(), a[0]).detach(), SCALAR.f(X[None])[0] * a[0].float())
    close(BlackBox(fn, AGGREGATE)(BATCH, a), SCALAR.f(BATCH) * a.float())
    assert estimate(fn, BATCH, AGGREGATE, a).value.dtype == torch.float64
    assert seen == {torch.float32}
    kept = BlackBox(lambda z, k: SCALAR.f(z) * (k.dtype == torch.int64), AGGREGATE)
    close(kept(BATCH, whole), SCALAR.f(BATCH))  # other types stay as they are
    head = BlackBox(lambda z: z, AGGREGATE, head=lambda y, a: y.sum(1) * float(a.dtype == torch.float32))
    close(head(BATCH, a), BATCH.sum(1))


def test_a_layer_behind_autocast() -> None:
    model, inputs = nn.Linear(2, N), spread(8, -1.0, 1.0).view(4, 2).float()
    with torch.autocast("cpu", torch.bfloat16):
        z = model(inputs)
        y = BlackBox(SCALAR.f, AGGREGATE)(z)
    assert y.dtype == z.dtype == torch.bfloat16
    (gradient,) = torch.autograd.grad(y.sum(), z)
    close(gradient, estimate(SCALAR.f, z.detach().float(), AGGREGATE).gradient.bfloat16())


class Fitted(nn.Module):
    """A surrogate with a matrix product in it, and in its fit."""

    def fit(self, points: torch.Tensor, outputs: torch.Tensor) -> None:
        self.map = torch.linalg.lstsq(points, outputs).solution
        self.scale = (points @ self.map).square().mean() / outputs.square().mean()

    def forward(self, z: torch.Tensor) -> torch.Tensor:
        return self.scale * (z @ self.map)


@pytest.mark.parametrize("what", ["fn", "head", "surrogate"])
def test_autocast_does_not_reach_the_black_box(what: str) -> None:
    """Products of matrices in bfloat16 would round away the differences."""
    W = spread(N * 3, -1.0, 1.0).view(N, 3).float()

    def derivatives(autocast: bool) -> tuple[torch.Tensor, ...]:
        fn = (lambda z: 100.0 + z @ W) if what == "fn" else (lambda z: z[:, :3].sin())
        head = (lambda y: (y @ W.T).square().sum(1)) if what == "head" else (lambda y: y.square().sum(1))
        memory = Memory(Fitted()) if what == "surrogate" else None
        layer = BlackBox(fn, AGGREGATE.replace(seed=0, samples=8), head=head, memory=memory, value="smoothed")
        x = X.float().requires_grad_()
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            for _ in range(3 if memory is not None else 0):  # the surrogate is fitted, and its coefficient measured
                layer(x)
            assert memory is None or memory.coefficient > 0.5
            y = layer(x)
        (gradient,) = torch.autograd.grad(y, x, create_graph=True)
        (product,) = torch.autograd.grad(gradient.sum(), x)
        return y, gradient, product

    torch.testing.assert_close(derivatives(True), derivatives(False), rtol=1e-4, atol=1e-4)


@BOTH
@pytest.mark.parametrize("graph", ["closed form", "general"])
def test_a_forward_pass_makes_no_pass_over_the_samples_and_a_gradient_makes_one(
    graph: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    if graph == "general":
        monkeypatch.setattr(transforms, "forward_mode_active", lambda: True)
    passes: list[str] = []
    running: list[str] = []  # a pass that begins inside of another one is the same pass

    def counted(name: str, original: Callable[..., Tensor]) -> Callable[..., Tensor]:
        def call(*given: object) -> Tensor:
            passes.extend([name] * (not running))
            running.append(name)
            result = original(*given)
            running.pop()
            return result

        return call

    for module, name in ((kernels, "project"), (kernels, "accumulate"), (stein_sums, "gradient"), (stein_sums, "hvp")):
        monkeypatch.setattr(module, name, counted(name, getattr(module, name)))
    x = leaf()
    y = BlackBox(SCALAR.f, AGGREGATE)(x)
    assert passes == []  # the perturbation of x is zero there, and so is its projection
    y.backward()
    assert passes == ["accumulate" if graph == "general" else "gradient"]


def module_level(z: Tensor) -> Tensor:
    return SCALAR.f(z)


@pytest.mark.parametrize("kind", [BlackBox, SparseBlackBox])
def test_settings_are_checked_when_they_are_set(kind: type[nn.Module]) -> None:
    layer = kind(lambda z: z.expand(-1, 3), Smoothing(sigma=0.5, seed=0))
    with pytest.raises(TypeError, match="smoothing must be a Smoothing"):
        layer.smoothing = 0.3
    layer.smoothing = Smoothing(sigma=0.1)
    assert layer.smoothing.sigma == 0.1


def test_the_value_that_a_layer_returns_may_be_set() -> None:
    layer = BlackBox(lambda z: (z[:, 0] > 0.0).double(), Smoothing(sigma=0.5, samples=64, seed=0))
    x = torch.full((1,), 0.1)
    assert layer.value == "center"
    assert float(layer(x)) == 1.0
    layer.value = "smoothed"
    assert layer.value == "smoothed"
    assert 0.3 < float(layer(x)) < 0.9
    with pytest.raises(ValueError, match="value must be 'center' or 'smoothed', got 'mean'"):
        layer.value = "mean"


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
    target[1].smoothing = target[1].smoothing.replace(samples=9)  # settings that are to differ are set after loading
    assert target[1].smoothing == annealed.replace(samples=9)


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


@pytest.mark.parametrize(
    ("sampler", "samples", "stored", "outputs"),
    [
        ("random", 200, True, 1),
        ("random", 200, True, 8),
        ("random", 200, True, 20),
        ("random", 200, False, 1),
        ("random", 200, False, 20),
        ("sobol", 200, True, 8),
        ("orthogonal", 40, True, 1),
    ],
)
def test_any_number_of_threads_gives_the_same_bits(
    sampler: str, samples: int, stored: bool, outputs: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of more than 8 outputs, and of a wide Hessian, the same numbers but for rounding: the BLAS adds them."""
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
        results = [y.detach(), e.value, g.detach(), h, e.gradient, e.hvp(torch.ones(n)), e.standard_error("gradient")]
        return [*results, e.hessian_diagonal(), *([e.hessian()] if outputs == 1 else [])]

    before = torch.get_num_threads()
    try:
        expected = derivatives(1)
        exact = 2 if stored and (outputs > 8 or not extension.available) else 8
        for threads in (2, 3, 8):
            found = derivatives(threads)
            for one, two in zip(expected[:exact], found[:exact], strict=True):
                assert torch.equal(one, two)
            for one, two in zip(expected[exact:], found[exact:], strict=True):
                assert float((one - two).abs().max()) <= 1e-13 * float(one.abs().max())
    finally:
        torch.set_num_threads(before)


def test_autocast_does_not_reach_the_coordinates_of_an_affine_memory() -> None:
    n = 64
    W = normal(n, 100).float() / 8.0

    def gradient(*, autocast: bool) -> torch.Tensor:
        smoothing = Smoothing(sigma=0.1, samples=20, seed=0)
        layer = BlackBox(lambda z: z @ W, smoothing, head=SquaredError(), memory=Memory())
        x = torch.ones(4, n, requires_grad=True)
        with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
            for _ in range(6):
                y = layer(x, torch.zeros(4, 100))
        assert layer.memory is not None
        assert layer.memory.coefficient > 0.5
        return torch.autograd.grad(y.sum(), x)[0]

    assert torch.equal(gradient(autocast=True), gradient(autocast=False))


@pytest.mark.parametrize("kind", [BlackBox, SparseBlackBox])
def test_a_layer_that_learns_in_a_reentrant_checkpoint(kind: type[nn.Module]) -> None:
    """Of the mean square of (x0 + x1, x0 - 2 x1) the gradient at (2, 2) is (2, 8)."""
    W = torch.tensor([[1.0, 1.0], [1.0, -2.0]], dtype=torch.float64)
    smoothing = Smoothing(sigma=0.1, samples=20, seed=0)
    layer = (
        BlackBox(lambda z: z @ W, smoothing, memory=Memory())
        if kind is BlackBox
        else SparseBlackBox(lambda z: z @ W, smoothing, keep=2)
    )
    for _ in range(4):
        x = torch.full((4, 2), 2.0, dtype=torch.float64, requires_grad=True)
        checkpoint(layer, x, use_reentrant=True).square().mean(1).sum().backward()
    assert x.grad is not None
    torch.testing.assert_close(x.grad, vector(2.0, 8.0).expand(4, 2), rtol=0.05, atol=0.0)
