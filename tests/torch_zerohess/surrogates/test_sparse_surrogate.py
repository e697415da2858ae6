"""An affine map whose outputs depend on few parameters each, from fewer points than parameters."""

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.surrogates import automatic
from torch_zerohess.surrogates.automatic import AutomaticSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.sparse_surrogate import SparseSurrogate

n, SHAPE, P = 150, (10, 12), 60


def normal(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def sparse_map(entries=2):
    """[120, n], so many entries in every row; the last parameter has none."""
    generator = torch.Generator().manual_seed(1)
    A = torch.zeros(120, n)
    for row in A:
        row[torch.randperm(n - 1, generator=generator)[:entries]] = 1.0 + torch.rand(entries, generator=generator)
    return A


A = sparse_map()


def image(z):
    return (1.0 + z @ A.to(z).mT).unflatten(1, SHAPE)


@pytest.fixture(scope="module")
def fitted():
    surrogate = SparseSurrogate(keep=4)
    surrogate.fit(normal(P, n), image(normal(P, n)))
    return surrogate


def error(surrogate):
    """Mean square at other points, over the variance."""
    z = normal(40, n, seed=5)
    return float((surrogate(z) - image(z)).square().mean() / image(z).var())


def test_it_predicts_from_fewer_points_than_parameters(fitted):
    linear = LinearSurrogate()
    linear.fit(normal(P, n), image(normal(P, n)))
    assert error(linear) > 0.4
    assert error(fitted) < 1e-3
    assert fitted.jacobian.explained > 0.9
    assert fitted.jacobian.explained_dense < 0.6
    assert bool(fitted.jacobian.untouched[-1])


def test_its_derivative_is_the_map(fitted):
    z = normal(n, seed=6).double()
    jacobian = torch.func.jacrev(lambda one: fitted(one[None])[0])(z)
    torch.testing.assert_close(jacobian.flatten(0, 1), fitted.jacobian.dense().view(120, n).double())
    assert float((jacobian.flatten(0, 1) - A).norm() / A.norm()) < 0.03


@pytest.mark.parametrize(
    ("middle", "length", "offset", "size", "dtype"),
    [
        (0.0, 1.0, 0.0, 1e-30, torch.float32),
        (0.0, 1.0, 0.0, 1e25, torch.float32),
        (0.0, 1e-25, 0.0, 1.0, torch.float32),
        (0.0, 1e25, 0.0, 1e10, torch.float32),
        (0.0, 1e-60, 0.0, 1e-50, torch.float64),
        (1e6, 1e-3, 0.0, 1.0, torch.float64),
        (0.0, 1.0, 1e8, 1.0, torch.float64),
    ],
)
@pytest.mark.parametrize("kind", [SparseSurrogate, AutomaticSurrogate])
def test_points_and_outputs_in_any_units(kind, middle, length, offset, size, dtype):
    """The same map with other units and origins is known as well as `test_it_predicts_from_fewer_points` wants it."""
    z, other = normal(P, n), normal(40, n, seed=5)
    surrogate = kind()
    surrogate.fit(z.to(dtype) * length + middle, image(z).to(dtype) * size + offset)
    found = (surrogate(other.to(dtype) * length + middle) - offset) / size
    assert float((found - image(other)).square().mean() / image(other).var()) < 1e-3


def test_a_memory_takes_it_where_it_predicts_better():
    memory = zh.Memory()
    memory.add(normal(P, n), image(normal(P, n)))
    memory.fit()
    assert isinstance(memory.surrogate, AutomaticSurrogate)
    assert isinstance(memory.surrogate.model, SparseSurrogate)
    assert error(memory.surrogate) < 1e-3


def test_an_exact_sparse_map_is_taken_where_points_determine_the_dense_one_too():
    memory, z = zh.Memory(), normal(4 * n, n)
    memory.add(z, image(z))
    memory.fit()
    model = memory.surrogate.model
    assert isinstance(model, SparseSurrogate)
    assert model.jacobian.explained < model.jacobian.explained_dense


def test_a_dense_map_and_few_points_keep_the_map_of_least_norm():
    dense = normal(n, 120, seed=3) / n**0.5
    automatic, linear = AutomaticSurrogate(), LinearSurrogate()
    z = normal(P, n)
    for one in (automatic, linear):
        one.fit(z, (z @ dense).unflatten(1, SHAPE))
    torch.testing.assert_close(automatic(2 * z), linear(2 * z), rtol=1e-3, atol=1e-3)
    automatic.fit(z[:5], image(z[:5]))
    torch.testing.assert_close(automatic(z[:5]), image(z[:5]), rtol=1e-3, atol=1e-3)


def test_a_dense_map_of_slightly_more_points_than_parameters():
    """Steps of a dense map: the fit to 134 points explains 96 %, and that to three quarters of them nothing."""
    slopes = normal(100, 100, seed=1) / 10.0
    for seed in range(2):
        z, other = normal(134, 100, seed=seed), normal(50, 100, seed=9)
        surrogate = AutomaticSurrogate()
        surrogate.fit(z, (3.0 * z @ slopes).round() / 3.0)
        assert isinstance(surrogate.model, LinearSurrogate)
        assert float((surrogate(other) - other @ slopes).square().mean()) < 0.1


def test_a_sparse_map_of_slightly_more_points_than_parameters(monkeypatch):
    """In noise of half its size: there the sparse map is better than least squares of all points, too."""
    for points in (n + 50, 3 * n):
        z, surrogate = normal(points, n), AutomaticSurrogate()
        surrogate.fit(z, image(z) + normal(points, *SHAPE, seed=3))
        assert isinstance(surrogate.model, SparseSurrogate)
        monkeypatch.setattr(automatic, "left_out_share", None)  # nor is it asked for with more points


@pytest.mark.parametrize("points", [300, 1200])
def test_a_memory_keeps_the_map_of_least_norm_of_a_curved_dense_function(points):
    """40 parameters and 70 outputs, of whose change an affine map predicts 99.5 %."""
    memory, z = zh.Memory(), normal(points, 40)
    slopes, curvatures = normal(40, 70, seed=1) / 40**0.5, normal(40, 70, seed=2) / 40**0.5
    memory.add(z, z @ slopes + 0.05 * z.square() @ curvatures)
    memory.fit()
    assert isinstance(memory.surrogate.model, LinearSurrogate)
    other = normal(2, 40, seed=3)
    change = memory.surrogate(other)[0] - memory.surrogate(other)[1]
    true = (other[0] - other[1]) @ slopes
    assert float((change - true).norm() / true.norm()) < 0.05


def test_very_few_points_give_their_mean():
    surrogate = SparseSurrogate()
    surrogate.fit(normal(5, n), image(normal(5, n)))
    torch.testing.assert_close(surrogate(normal(2, n)), image(normal(5, n)).mean(0).expand(2, *SHAPE))


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"keep": 0}, "keep must be at least 1, got 0"),
        ({"capacity": 1}, "capacity must be at least 2, got 1"),
        ({"rate": 2.0}, "rate must be positive and below 1, got 2.0"),
        ({"grid": (3, 4)}, "grid must be rows and columns"),
    ],
)
def test_wrong_settings_are_named(settings, message):
    with pytest.raises(ValueError, match=message):
        SparseSurrogate(**settings).fit(normal(P, n), image(normal(P, n)))


@pytest.mark.parametrize(
    ("settings", "error", "message"),
    [
        ({"rate": 0.0}, ValueError, "rate must be positive and below 1, got 0.0"),
        ({"rate": "a"}, TypeError, "rate must be"),
        ({"grid": (3,)}, ValueError, "grid must be rows and columns"),
        ({"grid": [True, True]}, TypeError, "grid must be rows and columns"),
    ],
)
def test_settings_are_checked_when_they_are_given(settings, error, message):
    with pytest.raises(error, match=message):
        SparseSurrogate(**settings)
