"""The term of an affine surrogate under a squared error is known: its value and derivatives have no noise."""

import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.surrogates.automatic import AutomaticSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.low_rank import LowRank, LowRankSurrogate
from torch_zerohess.surrogates.sparse_surrogate import SparseSurrogate
from truths import normal

n, B, SHAPE = 40, 3, (12, 10)
SIGMA = torch.linspace(0.1, 0.5, n, dtype=torch.float64)


def image(z: Tensor) -> Tensor:
    """Each of 120 elements depends on two of 40 parameters: [K, 40] -> [K, 12, 10]."""
    k = torch.arange(120)
    return (2.0 * z[:, k % n] - z[:, (7 * k + 3) % n] + 0.01 * k).unflatten(1, SHAPE)


SURROGATES = {
    "linear": LinearSurrogate,
    "low rank": lambda: LowRankSurrogate(LinearSurrogate(), rank=64),
    "sparse": lambda: SparseSurrogate(keep=4),
    "automatic": AutomaticSurrogate,
}


@pytest.fixture(params=SURROGATES)
def layer(request):
    memory = zh.Memory(SURROGATES[request.param](), fresh=0)
    points = normal(200, n, seed=0)
    memory.add(points, image(points))
    memory.fit()
    smoothing = zh.Smoothing(sigma=SIGMA.tolist(), samples=1)
    return zh.BlackBox(image, smoothing, head=zh.heads.SquaredError(), memory=memory, value="smoothed")


def truth(layer: zh.BlackBox, x: Tensor, references: Tensor) -> Tensor:
    """E mean((g(x + sigma u) - r)^2) for affine g: the error at x, and the variance of an element of g."""
    surrogate = layer.memory.surrogate
    slope = torch.func.jacrev(lambda one: surrogate(one[None])[0])(x[0].detach())
    return (surrogate(x) - references).square().mean((1, 2)) + (slope * SIGMA).square().sum(2).mean()


def test_value_gradient_and_hessian_are_exact(layer):
    x, references = normal(B, n, seed=1), normal(B, *SHAPE, seed=2)
    torch.testing.assert_close(layer(x, references), truth(layer, x, references), rtol=1e-5, atol=0.0)
    for of in (torch.func.grad, torch.func.hessian, lambda one: torch.func.jacrev(torch.func.jacrev(one))):
        found = of(lambda z: layer(z, references).sum())(x)
        torch.testing.assert_close(found, of(lambda z: truth(layer, z, references).sum())(x), rtol=1e-5, atol=1e-8)


def test_two_calls_are_equal(layer):
    x, references = normal(B, n, seed=1), normal(B, *SHAPE, seed=2)
    assert torch.equal(layer(x, references), layer(x, references))


def test_new_evaluations_correct_it():
    """The black box is the map plus a constant that the surrogate does not know: the layer knows the sum."""
    memory = zh.Memory(LinearSurrogate())
    points = normal(200, n, seed=0)
    memory.add(points, image(points))
    memory.fit()
    memory.regression.observe(normal(2, 9, seed=3), normal(2, 9, seed=3))
    assert memory.coefficient > 0.0
    smoothing = zh.Smoothing(sigma=0.3, samples=2000, seed=0, proposal="gaussian")
    layer = zh.BlackBox(
        lambda z: image(z) + 1.0, smoothing, head=zh.heads.SquaredError(), memory=memory, value="smoothed"
    ).eval()
    x, references = normal(B, n, seed=1), normal(B, *SHAPE, seed=2)
    expected = (image(x) + 1.0 - references).square().mean((1, 2)) + 5.0 * 0.3**2
    torch.testing.assert_close(layer(x, references), expected, rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("head", [zh.heads.SquaredError(), zh.heads.LocalEntropy(zh.heads.SquaredError())])
def test_references_are_split_once_per_call(head, monkeypatch):
    memory = zh.Memory(LowRankSurrogate(LinearSurrogate(), rank=64), fresh=2)
    points = normal(200, n, seed=0)
    memory.add(points, image(points))
    memory.fit()
    memory.regression.observe(normal(2, 9, seed=3), normal(2, 9, seed=3))
    layer = zh.BlackBox(image, zh.Smoothing(sigma=0.3, samples=2, seed=0), head=head, memory=memory, value="smoothed")
    calls, split = [], LowRank.split
    monkeypatch.setattr(LowRank, "split", lambda space, outputs: calls.append(len(outputs)) or split(space, outputs))
    x, references = normal(B, n, seed=1).requires_grad_(), normal(B, *SHAPE, seed=2)
    torch.autograd.grad(layer(x, references).sum(), x)
    assert calls == [B]
    if head == zh.heads.SquaredError():
        zh.estimate(image, x, layer.smoothing, references, head=head, memory=memory)
        assert calls == [B, B]


class Weighted(zh.heads.SquaredError):
    """A head of the caller's: three times the squared error."""

    def __call__(self, outputs: Tensor, references: Tensor) -> Tensor:
        return 3.0 * super().__call__(outputs, references)


class Squares:
    """A surrogate of the caller's that is not affine, though its model is."""

    def __init__(self) -> None:
        self.model = LinearSurrogate()

    def fit(self, points: Tensor, outputs: Tensor) -> None:
        self.model.fit(points, outputs)

    def __call__(self, z: Tensor) -> Tensor:
        return self.model(z).square()


def test_a_head_or_a_surrogate_of_the_callers_is_taken_as_it_is():
    points, x, references = normal(200, n, seed=0), normal(B, n, seed=1), normal(B, *SHAPE, seed=2)

    def layer(head, surrogate, draws=4000):
        memory = zh.Memory(surrogate, fresh=0, draws=draws)
        memory.add(points, image(points))
        memory.fit()
        smoothing = zh.Smoothing(sigma=SIGMA.tolist(), samples=1, seed=0)
        return zh.BlackBox(image, smoothing, head=head, memory=memory, value="smoothed")

    once = layer(zh.heads.SquaredError(), LowRankSurrogate(LinearSurrogate(), rank=64))(x, references)
    three = layer(Weighted(), LowRankSurrogate(LinearSurrogate(), rank=64))(x, references)
    torch.testing.assert_close(three, 3.0 * once, rtol=1e-2, atol=0.0)

    model = LinearSurrogate()
    model.fit(points, image(points))
    slope = torch.func.jacrev(lambda one: model(one[None])[0])(x[0])
    variance = (slope * SIGMA).square().sum(2)
    mean = model(x).square() + variance  # of g^2, and the fourth moment of g
    fourth = model(x) ** 4 + 6.0 * model(x).square() * variance + 3.0 * variance.square()
    expected = (fourth - 2.0 * references * mean + references.square()).mean((1, 2))
    found = layer(zh.heads.SquaredError(), Squares())(x, references)
    torch.testing.assert_close(found, expected, rtol=2e-2, atol=0.0)


class Doubled(LowRankSurrogate):
    """A subclass that does not predict what its coordinates say."""

    def __call__(self, z: Tensor) -> Tensor:
        return 2.0 * super().__call__(z)


def test_coordinates_of_a_subclass_are_not_used():
    points, x, references = normal(200, n, seed=0), normal(B, n, seed=1), normal(B, *SHAPE, seed=2)
    memory = zh.Memory(Doubled(LinearSurrogate(), rank=64), fresh=0)
    memory.add(points, image(points))
    memory.fit()
    layer = zh.BlackBox(image, zh.Smoothing(sigma=0.01, samples=1), head=zh.heads.SquaredError(), memory=memory)
    expected = (2.0 * image(x) - references).square().mean((1, 2))
    torch.testing.assert_close(layer(x.requires_grad_(), references), expected, rtol=1e-3, atol=0.0)


class Module(torch.nn.Module):
    """A surrogate of the caller's with an attribute of the same name as ours."""

    space = "the unit box"

    def forward(self, z: Tensor) -> Tensor:
        return image(z)


def test_a_module_may_have_a_space_of_its_own():
    layer = zh.BlackBox(
        image, zh.Smoothing(sigma=0.01, samples=1), head=zh.heads.SquaredError(), memory=zh.Memory(Module(), fresh=0)
    )
    x, references = normal(B, n, seed=1), normal(B, *SHAPE, seed=2)
    expected = (image(x) - references).square().mean((1, 2))
    torch.testing.assert_close(layer(x.requires_grad_(), references), expected, rtol=1e-3, atol=0.0)


@pytest.mark.parametrize("model", [None, LinearSurrogate])
def test_one_number_per_point_has_a_squared_error(model):
    """E (a u + b)^2 of an affine function, with a memory and without one: its square and its variance."""
    slope, points = normal(n, seed=4), normal(200, n, seed=0)
    memory = None if model is None else zh.Memory(model(), fresh=0)
    if memory is not None:
        memory.add(points, points @ slope)
        memory.fit()
    smoothing = zh.Smoothing(sigma=0.3, samples=1 if memory else 4000, seed=0, proposal="gaussian")
    head = zh.heads.SquaredError()
    layer = zh.BlackBox(lambda z: z @ slope, smoothing, head=head, memory=memory, value="smoothed")
    x, references = normal(B, n, seed=1), normal(B, seed=2)
    expected = (x @ slope - references).square() + 0.09 * slope.square().sum()
    torch.testing.assert_close(layer(x, references), expected, rtol=1e-6 if memory else 0.05, atol=0.0)


@pytest.mark.parametrize("of", SURROGATES)
def test_wrong_references_are_named(of):
    memory, points = zh.Memory(SURROGATES[of](), fresh=0), normal(200, n, seed=0)
    memory.add(points, image(points))
    memory.fit()
    layer = zh.BlackBox(image, zh.Smoothing(sigma=0.3, samples=1), head=zh.heads.SquaredError(), memory=memory)
    x, references = normal(B, n, seed=1).requires_grad_(), normal(B, *SHAPE, seed=2)
    for aux in ((), (references, references)):
        with pytest.raises(TypeError, match=f"aux must be the references alone, one tensor, .* got {len(aux)} tensors"):
            layer(x, *aux)
    for wrong in (references > 0.0, references.to(torch.complex128)):
        with pytest.raises(TypeError, match=f"references must be real numbers, got {wrong.dtype}"):
            layer(x, wrong)
