"""One call of the black box: what it is given, what becomes of values that are not finite, and the baseline."""

import math
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np
import pandas
import pytest
import torch
from PIL import Image
from torch import Tensor

from torch_zerohess import BlackBox, Smoothing, estimate, sparse_jacobian
from torch_zerohess.estimation.coefficients import mean_of_others
from torch_zerohess.evaluators.values import as_tensor, checked_values
from truths import spread, squares, vector

S = Smoothing(sigma=0.5, samples=8, proposal="gaussian", seed=1)
X = vector(0.1, 0.2)


def holes(*rows: int):
    """Squares, but nan at some of the points of a call."""

    def fn(z: Tensor) -> Tensor:
        values = squares(z)
        values[list(rows)] = math.nan
        return values

    return fn


def test_a_center_that_is_not_finite_cannot_be_dropped() -> None:
    """The last point is x itself. Other points are not finite either, but the message names x."""
    with pytest.raises(ValueError, match=r"nan at the point \[0\.1, 0\.2\], which is x itself.*choose baseline='mean'"):
        estimate(holes(0, 16), X, S, on_nonfinite="drop")
    for baseline in ("none", "mean"):
        without = S.replace(baseline=baseline)
        assert estimate(holes(0), X, without, value="smoothed", on_nonfinite="drop").dropped == 2


def test_the_other_one_of_a_dropped_pair_goes_with_it() -> None:
    got = estimate(holes(2, 11), X, S, on_nonfinite="drop")
    assert got.dropped == 4  # rows 2, 10 and 3, 11
    kept = [k for k in range(16) if k % 8 not in (2, 3)]
    u = (got.points[:-1] - X) / 0.5
    by_hand = ((squares(got.points[:-1]) - squares(X[None]))[:, None] * u)[kept].mean(0) / 0.5
    torch.testing.assert_close(got.gradient, by_hand)
    single = estimate(holes(2), X, S.replace(antithetic=False), on_nonfinite="drop")
    assert single.dropped == 1


def test_too_few_draws_left_is_an_error() -> None:
    everything_but_one = holes(*range(1, 8))
    with pytest.warns(UserWarning, match="drops most draws around a point.*in a region.*give a number"):
        assert estimate(everything_but_one, X, S, on_nonfinite="drop").dropped == 14
    with pytest.raises(ValueError, match="left 1 of 8 draws, 2 are needed"):
        estimate(everything_but_one, X, S.replace(baseline="mean"), on_nonfinite="drop")
    with pytest.raises(ValueError, match="left 0 of 8 draws, 1 are needed"):
        estimate(holes(*range(8)), X, S, on_nonfinite="drop")
    # 16 points in two scrambles: a whole scramble is dropped, and one draw remains.
    sobol = S.replace(samples=16, sampler="sobol", baseline="mean")
    with pytest.raises(ValueError, match="left one independent draw, baseline 'mean' needs two"):
        estimate(holes(*range(8)), X, sobol, on_nonfinite="drop", value="smoothed")


def test_an_element_in_a_region_without_values_is_noticed_in_a_batch() -> None:
    """One of 40 elements lies where fn fails. Chance takes as much from some of them, and that is no warning."""
    x = torch.zeros(40, 2, dtype=torch.float64)
    x[7, 0] = 1.3
    generator, left = torch.Generator().manual_seed(0), []

    def fails_above_one(z: Tensor) -> Tensor:
        return torch.where(z[:, 0] > 1.0, math.nan, squares(z))

    def fails_at_random(z: Tensor) -> Tensor:
        lost = torch.rand(len(z), generator=generator) < 0.4
        left.append(float((~lost).reshape(40, 32).double().mean(1).min()))
        return torch.where(lost, math.nan, squares(z))

    single = S.replace(samples=32, antithetic=False, baseline="mean")
    with pytest.warns(UserWarning, match="drops most draws around a point"):
        estimate(fails_above_one, x, single, value="smoothed", on_nonfinite="drop")
    estimate(fails_at_random, x, single, value="smoothed", on_nonfinite="drop")
    assert left[0] < 0.5


def test_where_nothing_is_finite_the_error_says_so() -> None:
    """Also where x itself is one of the points: another baseline would not help."""
    with pytest.raises(
        ValueError, match=r"left 0 of 8 draws, 1 are needed: 17 of 17 values are not finite; fn returned"
    ):
        estimate(holes(*range(17)), X, S, on_nonfinite="drop")


def test_x_alone_cannot_be_dropped() -> None:
    message = r"fn returned nan at the point \[0\.1, 0\.2\], which is x itself .* choose on_nonfinite=<a number>"
    with torch.no_grad(), pytest.raises(ValueError, match=message):
        BlackBox(holes(0), S, on_nonfinite="drop")(X)


def test_a_head_that_is_not_finite_is_named() -> None:
    """Where the output of fn is finite, the head is to blame."""

    def log(outputs: Tensor) -> Tensor:
        return outputs[:, 0].log()

    layer, x = BlackBox(lambda z: z - 0.2, S, head=log), X.clone().requires_grad_()
    message = r"head returned nan at the point \[-?0?.*where the output of fn is finite, from -.* to .*: look at head"
    for call in (lambda: layer(x), lambda: layer(X), lambda: estimate(lambda z: z - 0.2, X, S, head=log)):
        with pytest.raises(ValueError, match=message):
            call()
    one = r"head returned nan at the point \[.*where the output of fn is finite, \[-.*\]: look at head"
    with pytest.raises(ValueError, match=one):
        estimate(lambda z: z[:, :1] - 0.2, X, S, head=log)
    with pytest.raises(ValueError, match="fn returned nan at the point"):
        estimate(lambda z: z / 0.0 - z / 0.0, X, S, head=log)
    with pytest.warns(UserWarning, match="drops most draws"):
        got = estimate(lambda z: z, X, S, head=log, on_nonfinite="drop")
    assert 0 < got.dropped < 16
    with pytest.raises(ValueError, match=r"left 0 of 8 draws.*17 of 17 values are not finite; head returned nan"):
        estimate(lambda z: z - 9.0, X, S, head=log, on_nonfinite="drop")


def test_the_sets_of_optimal_sampling_cannot_be_dropped_from() -> None:
    with pytest.raises(ValueError, match="cannot re-weight the element-wise sets of proposal 'optimal'"):
        estimate(holes(3), X, S.replace(proposal="optimal"), on_nonfinite="drop")


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_a_number_in_place_of_nan_keeps_its_precision(dtype: torch.dtype) -> None:
    """1e6 is infinite in float16, and 0.1 is another number in float32."""
    for number in (1e6, 0.1):
        fn = holes(0)
        got = estimate(lambda z, fn=fn: fn(z).to(dtype), X, S, on_nonfinite=number)
        assert float(got.values[0]) == number
        layer = BlackBox(lambda z: torch.full_like(z[:, 0], math.nan).to(dtype), S, on_nonfinite=number)
        with torch.no_grad():
            assert float(layer(X)) == number


def test_the_function_cannot_change_auxiliary_inputs() -> None:
    a = torch.ones(2)

    def greedy(z: Tensor, one: Tensor) -> Tensor:
        result = squares(z) * one.sum(1)
        one.zero_()
        return result

    x = X.expand(2, 2)
    with torch.no_grad():
        BlackBox(greedy, S)(x, a[:, None])
    estimate(greedy, x, S, a[:, None])
    assert torch.equal(a, torch.ones(2))


def test_the_baseline_is_the_mean_of_the_other_draws() -> None:
    """Draws of one, two and three rows, one row dropped: every row gets the mean over the rows of the other draws."""
    values, draws = spread(6, -1.0, 3.0).view(1, 6, 1), [[[0]], [[1, 2]], [[3, 4, 5]]]
    kept = torch.tensor([1.0, 1.0, 1.0, 1.0, 0.0, 1.0], dtype=torch.float64)
    share = (kept / kept.sum()).view(1, 6, 1)
    got = mean_of_others(values, share, [torch.tensor(one) for one in draws])[0, :, 0]
    f = values[0, :, 0]
    first, second, third = f[0], f[1:3].sum(), f[3] + f[5]
    expected = [(second + third) / 4, *[(first + third) / 3] * 2, *[(first + second) / 3] * 3]
    torch.testing.assert_close(got, torch.stack(expected))


def test_the_baseline_of_a_constant_is_the_constant_to_the_bit() -> None:
    """Otherwise the rounding of a large offset would look like a variation of f."""
    for K in (3, 7, 11, 13):
        values = torch.full((1, K, 1), 1e12 / 3, dtype=torch.float64)
        share = torch.full((1, K, 1), 1 / K, dtype=torch.float64)
        assert torch.equal(mean_of_others(values, share, [torch.arange(K)[:, None]]), values)


OFFSET = {
    "list": (lambda z: [1e9 + float(one) for one in z[:, 0]], True),
    "tuple": (lambda z: tuple(1e9 + float(one) for one in z[:, 0]), True),
    "list of lists": (lambda z: [[1, 1e9 + float(one)] for one in z[:, 0]], True),
    "list of one point": (lambda z: [1e9 + float(z[0])], False),
    "number of one point": (lambda z: 1e9 + float(z[0]), False),
    "list of NumPy numbers": (lambda z: list(1e9 + z[:, 0].numpy()), True),
}


@pytest.mark.parametrize("name", OFFSET)
def test_numbers_of_python_are_float64(name: str) -> None:
    """1e9 + z is 1e9 in float32: the gradient would be zero."""
    fn, vectorized = OFFSET[name]
    got = estimate(fn, X, S, vectorized=vectorized)
    expected = estimate(lambda z: z[:, 0], X, S).gradient
    slope = got.gradient.reshape(-1, 2)[-1]
    torch.testing.assert_close(slope, expected, rtol=0.0, atol=1e-5)  # 1e9 is rounded to steps of 1.2e-7
    y = BlackBox(fn, S, vectorized=vectorized)(X.clone().requires_grad_()).detach().flatten()
    assert abs(float(y[-1]) - 1e9 - 0.1) < 1e-6


def test_lists_keep_the_precision_of_what_is_in_them() -> None:
    for dtype in (torch.float32, torch.float64):
        assert estimate(lambda z, t=dtype: list(z[:, 0].to(t)), X, S).values.dtype == dtype
    assert estimate(lambda z: [1] * len(z), X, S).values.dtype == torch.float64


COUNTS = {
    "truth values": lambda z: z[:, 0] > 0.2,
    "of NumPy": lambda z: (z[:, 0] > 0.2).numpy(),
    "of bytes": lambda z: (z[:, 0] > 0.2).byte(),
    "of Python": lambda z: [bool(one > 0.2) for one in z[:, 0]],
    "big-endian": lambda z: (z[:, 0] > 0.2).double().numpy().astype(">f8"),
    "long doubles": lambda z: (z[:, 0] > 0.2).numpy().astype(np.longdouble),
}


@pytest.mark.parametrize("fn", COUNTS.values(), ids=COUNTS.keys())
def test_integers_and_truth_values_are_numbers(fn) -> None:
    expected = estimate(lambda z: (z[:, 0] > 0.2).double(), X, S)
    assert torch.equal(estimate(fn, X, S).gradient, expected.gradient)
    one = estimate(lambda z: int(z[0] > 0.2), X, S, vectorized=False)  # all of them 0 on a plateau
    assert torch.equal(one.gradient, expected.gradient)


class Picture:
    """Numbers by the array interface alone, as an image of Pillow has them."""

    def __init__(self, array: np.ndarray) -> None:
        self._array = array
        self.__array_interface__ = array.__array_interface__


def test_what_has_the_array_interface_is_an_array() -> None:
    bytes_ = lambda z: (z.numpy() > 0.2).astype(np.uint8)  # noqa: E731
    got = estimate(lambda z: Picture(bytes_(z)), X, S).gradient
    assert torch.equal(got, estimate(bytes_, X, S).gradient)


@pytest.mark.parametrize(
    ("kind", "expected"), [("f4", torch.float32), ("f8", torch.float64), ("i8", torch.float64), ("u1", torch.float64)]
)
def test_masked_entries_are_not_a_number(kind, expected) -> None:
    masked = np.ma.array([[1, 2], [3, 4]], mask=[[False, True], [False, False]], dtype=kind)
    found = as_tensor(masked)
    assert found.dtype == expected
    assert torch.equal(found.nan_to_num(nan=9.0), torch.tensor([[1.0, 9.0], [3.0, 4.0]], dtype=expected))
    assert torch.equal(as_tensor(list(masked)).isnan(), found.isnan())
    assert masked[0, 1] is np.ma.masked


@pytest.mark.parametrize("large", [2**63 - 1, 2**63, -(2**63) - 1, 10**30])
def test_an_integer_may_be_of_any_size(large) -> None:
    for values in (large, [large, 3], [[3], [large]], [large, 2.5], (True, large)):
        assert torch.equal(as_tensor(values), torch.tensor(values, dtype=torch.float64))
    with pytest.raises(TypeError, match=r"fn must return a tensor or .* numbers, got list: int too large to convert"):
        as_tensor([10**400, large])


def test_a_sparse_tensor_is_filled() -> None:
    dense = vector(0.0, 2.0, 0.0)[:, None]
    for sparse in (dense.to_sparse(), dense.long().to_sparse()):
        assert torch.equal(as_tensor(sparse), dense)
    estimate(lambda z: z.square().sum(1).to_sparse(), vector(1.0, 2.0), Smoothing(sigma=0.1, samples=8))


def test_lists_of_arrays_are_one_array(recwarn) -> None:
    got = estimate(lambda z: [np.sin(one) for one in z.numpy()], X, S).gradient
    assert torch.equal(got, estimate(torch.sin, X, S).gradient)
    assert not recwarn.list


ROWS = {
    "list": lambda z: [torch.stack([one.sum(), one[0].square()]) for one in z],
    "tuple of tuples of numbers": lambda z: tuple((float(one.sum()), float(one[0]) ** 2) for one in z),
    "list of lists of numbers": lambda z: [[one.sum(), one[0].square()] for one in z],
    "list of lists of tensors": lambda z: [[one.sum()[None], one[:1].square()] for one in z],
    "float32 before float64": lambda z: [
        torch.stack([one.sum(), one[0].square()]).to(torch.float64 if k else torch.float32) for k, one in enumerate(z)
    ],
    "list of long doubles": lambda z: [np.stack([one.sum(), one[0] ** 2]) for one in z.numpy().astype(np.longdouble)],
}


@pytest.mark.parametrize("rows", ROWS.values(), ids=ROWS.keys())
def test_a_list_of_rows_is_stacked(rows: Callable[[Tensor], Any]) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        got = estimate(rows, X, S).gradient
    same = estimate(lambda z: torch.stack([z.sum(1), z[:, 0].square()], 1), X, S).gradient
    torch.testing.assert_close(got.reshape(same.shape), same, rtol=1e-5, atol=1e-5)


def test_pictures_and_tables_are_arrays() -> None:
    pixels = np.arange(24, dtype=np.uint8).reshape(2, 3, 4)
    pictures = [Image.fromarray(one) for one in pixels]
    assert torch.equal(as_tensor(pictures[0]), torch.from_numpy(pixels[0]).double())
    assert torch.equal(as_tensor(pictures), torch.from_numpy(pixels).double())
    missing = as_tensor([math.nan, pictures[1]])
    assert missing[0].isnan().all()
    assert torch.equal(missing[1], torch.from_numpy(pixels[1]).double())
    table = pandas.DataFrame(pixels[0], columns=["a", "b", "c", "d"], index=[7, 8, 9])
    assert torch.equal(as_tensor(table), torch.from_numpy(pixels[0]).double())
    assert torch.equal(as_tensor([table["a"], table["b"]]), torch.from_numpy(pixels[0, :, :2].T.copy()).double())


def test_a_tuple_with_a_value_for_each_point_is_told_to_be_a_list() -> None:
    z = torch.rand(3, 2)
    with pytest.raises(TypeError, match=r"a tuple of 3: return one .* dimension 1; one value per point may be a list$"):
        checked_values(tuple(z), z)
    with pytest.raises(TypeError, match=r"a tuple of 2: return one of them, or join them along dimension 1$"):
        checked_values((z, z), z)
    assert torch.equal(checked_values(list(z), z), z)


@pytest.mark.parametrize("count", [2, 17])
@pytest.mark.parametrize("second", [np.ones(17), torch.ones(17, 2), None, 3.0], ids=["array", "tensor", "None", "3.0"])
def test_several_results_of_a_batch_are_refused(second: Any, count: int) -> None:
    """As many results as points, too; a function of one point may return a tuple, and one of a batch a list."""
    z = torch.rand(count, 2, dtype=torch.float64)
    with pytest.raises(TypeError, match=r"^fn must return one tensor \[K, \*out\], got a tuple of 2: return one"):
        checked_values((squares(z), second), z)
    assert checked_values([squares(one[None]) for one in z], z).shape == (count, 1)
    assert checked_values(tuple(squares(one[None])[0] for one in z), z).shape == (count,)
    got = estimate(lambda one: (one.sum()[None], one[:1].square()), X, S, vectorized=False).value
    torch.testing.assert_close(got, torch.stack([X.sum()[None], X[:1].square()]))


@pytest.mark.parametrize("vectorized", [True, False])
def test_a_dictionary_is_several_results(vectorized: bool) -> None:
    def named(z: Tensor) -> dict[str, Tensor]:
        return {"image": z.square(), "depth": z}

    message = r"^fn must return one tensor \[K, \*out\], got a dict of 'image', 'depth': return one of its values"
    with pytest.raises(TypeError, match=message):
        estimate(named, X, S, vectorized=vectorized)
    with pytest.raises(TypeError, match=r"got a dict of 0, 1, 2, 3, 4, 5, 6, 7, \.\.\.: return"):
        estimate(lambda z: dict(enumerate(z.mT.repeat(9, 1))), X, S)


@pytest.mark.parametrize("kind", [torch.ones, np.ones])
def test_rows_of_different_shapes_are_refused(kind: Callable[[int], Any]) -> None:
    message = r"got list: rows must have one shape, got \[3\] for row 1 and \[2\] before"
    with pytest.raises(TypeError, match=message):
        estimate(lambda z: [kind(2 + k % 2) for k in range(len(z))], X, S)


@pytest.mark.parametrize("make", [lambda a: a[:, ::-1], lambda a: np.broadcast_to(a[:, :1], a.shape)])
def test_arrays_in_any_order_and_without_the_right_to_write(make, recwarn) -> None:
    got = estimate(lambda z: make(z.numpy()), X, S).gradient
    assert torch.equal(got, estimate(lambda z: torch.from_numpy(make(z.numpy()).copy()), X, S).gradient)
    assert not recwarn.list


@pytest.mark.parametrize("x_dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("returned", "number"), [(torch.float16, 1e6), (torch.float32, 1e40), (torch.bfloat16, 7.001)])
def test_the_number_in_place_of_nan_is_kept_in_float64(
    returned: torch.dtype, number: float, x_dtype: torch.dtype
) -> None:
    """The number has no finite, or no equal, counterpart in the type that fn returns."""
    x = X.to(x_dtype)
    bad = estimate(squares, x, S).points[[2, 11]]

    def fn(z: Tensor) -> Tensor:
        hole = (z[:, None] == bad).all(2).any(1)
        return torch.where(hole, math.nan, squares(z)).to(returned)

    def filled(z: Tensor) -> Tensor:
        return torch.nan_to_num(fn(z).double(), nan=number)

    for baseline in ("center", "mean", "none"):
        smoothing = S.replace(baseline=baseline, sigma=0.5)
        got = estimate(fn, x, smoothing, on_nonfinite=number, value="smoothed")
        expected = estimate(filled, x, smoothing, value="smoothed")
        assert got.values.dtype == torch.float64
        assert float(got.values.max()) == number
        if number < 1e38 or x_dtype == torch.float64:
            assert torch.equal(got.gradient, expected.gradient)
            assert torch.equal(got.hessian(), expected.hessian())
            assert torch.equal(got.value, expected.value)
    if number < 1e38 or x_dtype == torch.float64:
        layer = BlackBox(fn, S, on_nonfinite=number)
        leaf = x.clone().requires_grad_()
        (gradient,) = torch.autograd.grad(layer(leaf), leaf)
        torch.testing.assert_close(gradient, estimate(filled, x, S).gradient)
        with torch.no_grad():
            assert float(layer(bad[0])) == pytest.approx(number, rel=1e-7)
    else:  # the gradient does not exist in float32
        with pytest.raises(ValueError, match=r"the gradient is not finite in torch\.float32"):
            _ = estimate(fn, x, S, on_nonfinite=number).gradient


def strided() -> list[Tensor]:
    """Points [*batch, 4] whose numbers are not side by side in memory."""
    generator = torch.Generator().manual_seed(0)
    whole = torch.randn(2, 4, 3, 8, generator=generator, dtype=torch.float64)
    rows, columns = whole[0, :, 0].T[:4, :4].mT, whole[0, :, :, 0].T
    return [rows, columns, whole[0, 0, :, ::2], whole.permute(0, 2, 3, 1), X[:1].expand(3, 4)]


@pytest.mark.parametrize("value", ["center", "smoothed"])
@pytest.mark.parametrize("x", strided(), ids=lambda x: str([*x.shape]))
def test_the_function_gets_contiguous_tensors(x: Tensor, value: str) -> None:
    """A library that reads from a pointer would read other numbers, and `view` would raise."""
    aux = torch.stack([x, -x]).movedim(0, -1)  # not contiguous either
    calls = []

    def fn(*given: Tensor) -> Tensor:
        calls.append([one.is_contiguous() for one in given])
        return given[0].square().sum(-1)

    layer = BlackBox(fn, S, value=value)
    for requires_grad in (False, True):
        own = x.detach().requires_grad_(requires_grad)
        layer(own, aux)
        layer.freeze(own, aux)
        torch.func.vmap(layer, in_dims=x.dim() - 2, out_dims=x.dim() - 2)(own)
        with torch.no_grad():
            layer(own, aux)
    estimate(fn, x, S, aux, value=value)
    if x.dim() == 2:
        estimate(fn, x, S, aux, value=value, joint=True)
    assert len(calls) > 8
    assert all(all(one) for one in calls)


def test_an_evaluator_of_the_caller_records_nothing() -> None:
    """A module as black box has parameters that require grad."""
    network = torch.nn.Linear(2, 1, dtype=torch.float64)
    got = BlackBox(network, S, evaluator=lambda fn, points: fn(points))(X.clone().requires_grad_())
    assert torch.equal(got.detach(), BlackBox(network, S)(X))
    assert torch.equal(estimate(network, X, S, evaluator=lambda fn, points: fn(points)).value, got.detach())


def test_numbers_of_an_output_that_are_never_finite_are_counted():
    def image(z):
        out = z[:, :1].expand(-1, 100).clone()
        out[:, [3, 8]] = torch.nan
        return out

    message = r"24 of 24 values are not finite \(2 of their 100 numbers never are\); fn returned nan"
    with pytest.raises(ValueError, match=message):
        sparse_jacobian(image, torch.zeros(5).double(), Smoothing(sigma=1.0, samples=12), on_nonfinite="drop", keep=2)
