"""Bad inputs: the error names the argument, the value received and what would be right."""

import concurrent.futures
import math
import sys

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from torch_zerohess import BlackBox, Smoothing, SparseBlackBox, estimate, heads, smooth
from torch_zerohess.adapters.mitsuba import MitsubaScene
from torch_zerohess.adapters.onnx import OnnxFunction
from torch_zerohess.adapters.process import Program
from torch_zerohess.autograd import tracing
from torch_zerohess.evaluators import Factory
from truths import spread, squares, vector

S = Smoothing(sigma=0.5, samples=3, seed=1)
ONE = S.replace(samples=1)
X = vector(0.1, 0.2)


SETTINGS = [
    ({"sigma": 0.0}, ValueError, r"sigma must be positive and finite, got 0\.0"),
    ({"sigma": -0.3}, ValueError, r"sigma must be positive.*-0\.3"),
    ({"sigma": math.nan}, ValueError, r"sigma must be positive and finite, got nan"),
    ({"sigma": math.inf}, ValueError, r"sigma must be positive and finite, got inf"),
    ({"sigma": torch.tensor([0.1, -2.0])}, ValueError, r"sigma must be positive.*-2\.0"),
    ({"sigma": torch.tensor([0.1, math.inf])}, ValueError, "sigma must be positive and finite, got inf"),
    ({"sigma": torch.ones(2, 2)}, TypeError, r"sigma must be a positive number or a tensor \[n\]"),
    ({"sigma": torch.ones(0)}, TypeError, r"sigma must be a positive number or a tensor \[n\]"),
    ({"sigma": torch.ones(2, dtype=torch.complex64)}, TypeError, "sigma must be a positive number"),
    ({"sigma": torch.ones(2, requires_grad=True)}, ValueError, r"sigma must not require grad.*detach"),
    ({"sigma": [1.0, torch.tensor(2.0, requires_grad=True)]}, ValueError, r"sigma must not require grad.*detach"),
    ({"sigma": "wide"}, TypeError, r"sigma must be a positive number.*'wide'"),
    ({"sigma": None}, TypeError, r"sigma must be a positive number.*None"),
    ({"sigma": True}, TypeError, r"sigma must be a positive number.*True"),
    ({"sigma": np.array([True, True])}, TypeError, r"sigma must be a positive number.*True"),
    ({"samples": 0}, ValueError, "samples must be at least 1, got 0"),
    ({"samples": -5}, ValueError, "samples must be at least 1, got -5"),
    ({"samples": 4.0}, TypeError, r"samples must be an integer, got 4\.0"),
    ({"samples": True}, TypeError, "samples must be an integer, got True"),
    ({"samples": None}, TypeError, "samples must be an integer, got None"),
    ({"samples": 1, "baseline": "mean"}, ValueError, "samples must be at least 2, got 1"),
    ({"samples": 1, "baseline": "mean", "antithetic": "auto"}, ValueError, "samples must be at least 2, got 1"),
    ({"samples": 7, "baseline": "mean", "sampler": "sobol"}, ValueError, "samples must be even, .*got samples=7"),
    (
        {"samples": 3, "baseline": "mean", "sampler": "sobol", "antithetic": False},
        ValueError,
        "must be even.*got samples=3",
    ),
    (
        {"samples": 4, "scrambles": 1, "baseline": "mean", "sampler": "sobol"},
        ValueError,
        "scrambles None or at least 2, got samples=4, scrambles=1",
    ),
    ({"proposal": "cauchy"}, ValueError, "proposal must be one of 'aggregate', 'gaussian', .*got 'cauchy'"),
    ({"baseline": "median"}, ValueError, "baseline must be one of 'center', 'mean', 'none', 'auto', got 'median'"),
    ({"sampler": "halton"}, ValueError, "sampler must be one of 'random', 'sobol', 'orthogonal', 'auto', got 'halton'"),
    ({"antithetic": "yes"}, ValueError, "antithetic must be one of True, False, 'auto', got 'yes'"),
    ({"seed": -1}, ValueError, "seed must be at least 0, got -1"),
    ({"seed": 2**63}, ValueError, r"seed must be below 2\*\*63, got 9223372036854775808"),
    ({"seed": 1.5}, TypeError, r"seed must be an integer, got 1\.5"),
    ({"order": 3}, ValueError, "order must be 1 or 2, got 3"),
    ({"order": 0}, ValueError, "order must be at least 1, got 0"),
    ({"sampler": "sobol", "scrambles": 3}, ValueError, "scrambles must divide samples, got 3 of 8"),
    ({"sampler": "sobol", "scrambles": 0}, ValueError, "scrambles must be at least 1, got 0"),
    ({"sampler": "sobol", "scrambles": True}, TypeError, "scrambles must be an integer, got True"),
    ({"scrambles": 2}, ValueError, "scrambles need sampler 'sobol', got 2 with sampler 'random'"),
    ({"width": 1.0}, TypeError, "width"),
]


@pytest.mark.parametrize(("changes", "error", "message"), SETTINGS)
def test_settings(changes: dict, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        Smoothing(**{"sigma": 0.5, **changes})
    with pytest.raises(error, match=message):
        Smoothing(sigma=0.5).replace(**changes)


@pytest.mark.parametrize(
    "sigma",
    [
        [0.5, 0.25],
        (0.5, 0.25),
        np.array([0.5, 0.25]),
        np.array([0.25, 0.5])[::-1],
        np.array([0.5, 0.25], dtype=">f4"),
    ],
    ids=["list", "tuple", "array", "reversed", "big-endian"],
)
def test_sigma_of_any_kind(sigma: object) -> None:
    assert torch.equal(Smoothing(sigma=sigma).sigma, vector(0.5, 0.25))


def test_settings_are_frozen_keyword_only_and_own_their_sigma() -> None:
    with pytest.raises(TypeError):
        Smoothing(0.5)  # type: ignore[misc]
    with pytest.raises(AttributeError):
        S.samples = 3  # type: ignore[misc]
    sigma = torch.tensor([0.1, 0.2])
    smoothing = Smoothing(sigma=sigma)
    sigma[0] = -1.0
    assert float(smoothing.sigma_vector(2, sigma.device)[0]) == pytest.approx(0.1)
    assert (S.replace(samples=9).samples, S.samples) == (9, 3)


POINTS = [
    (torch.tensor([1, 2]), TypeError, r"x must be float32 or float64, got torch\.int64: convert"),
    (torch.ones(2, dtype=torch.complex128), TypeError, r"x must be float32 or float64, got torch\.complex128"),
    (torch.ones(2, dtype=torch.int8), TypeError, r"x must be float32 or float64, got torch\.int8"),
    (torch.ones(2, dtype=torch.bool), TypeError, r"x must be float32 or float64, got torch\.bool"),
    (torch.ones(0), ValueError, r"x must have shape \[\*batch, n\] with n.* > 0, got \[0\]"),
    (torch.ones(0, 3), ValueError, r"x must have .*got \[0, 3\]"),
    (torch.tensor(1.0), ValueError, r"x must have shape \[\*batch, n\].*got \[\]"),
    ([0.1, 0.2], TypeError, r"x must be a torch tensor \[\*batch, n\], got list"),
    (np.ones(2), TypeError, r"x must be a torch tensor \[\*batch, n\], got ndarray"),
    (None, TypeError, r"x must be a torch tensor \[\*batch, n\], got NoneType"),
]


@pytest.mark.parametrize(("x", "error", "message"), POINTS)
def test_points(x: object, error: type[Exception], message: str) -> None:
    layer = BlackBox(squares, S)
    for call in (
        lambda: estimate(squares, x, S),
        lambda: layer(x),
        lambda: layer.freeze(x),
        lambda: smooth(squares, S)(x),
    ):
        with pytest.raises(error, match=message):
            call()


FUNCTIONS = [
    (lambda z: z.sum(), ValueError, r"fn must return one value per point, \[K, \*out\].*got \[\].*vectorized=False"),
    (lambda z: z.sum(0), ValueError, r"fn must return one value per point, \[K, \*out\].*got \[2\]"),
    (lambda z: squares(z)[:-1], ValueError, r"\[K, \*out\] for points \[K, 2\], got \[[06]\]"),
    (lambda z: squares(z) * 1j, TypeError, r"fn must return real numbers, got torch\.complex128"),
    (lambda z: (squares(z) * 1j).numpy(), TypeError, r"fn must return real numbers, got torch\.complex128"),
    (lambda z: None, TypeError, "fn must return a tensor or a NumPy array of numbers, got NoneType"),
    (lambda z: "f", TypeError, "fn must return a tensor or a NumPy array of numbers, got str"),
    (lambda z: {"loss": squares(z)}, TypeError, "got a dict of 'loss': return one of its values"),
    (lambda z: squares(z).requires_grad_(), ValueError, r"fn returned a tensor that requires grad.*detached"),
    (
        lambda z: squares(z) + math.nan,
        ValueError,
        r"fn returned nan at the point \[0?.*on_nonfinite='drop' or a number",
    ),
    (lambda z: squares(z) / 0.0, ValueError, r"fn returned inf at the point \["),
    (lambda z: squares(z)[:, None] * vector(1.0, -math.inf), ValueError, r"fn returned -inf at the point \["),
]


@pytest.mark.parametrize(("fn", "error", "message"), FUNCTIONS)
def test_what_the_function_returns(fn, error: type[Exception], message: str) -> None:
    x = X.clone().requires_grad_()
    for call in (lambda: estimate(fn, X, S), lambda: BlackBox(fn, S)(x), lambda: torch.func.grad(smooth(fn, S))(X)):
        with pytest.raises(error, match=message.replace("K", "7")):
            call()


def test_what_the_function_returns_where_only_the_value_is_asked_for() -> None:
    for fn, error, message in FUNCTIONS:
        with torch.no_grad(), pytest.raises(error, match=message.replace("K", "1")):
            BlackBox(fn, S)(X)


def test_errors_of_the_function_itself_arrive_as_they_are() -> None:
    def fails(z: Tensor) -> Tensor:
        raise KeyError("my own")

    for call in (lambda: estimate(fails, X, S), lambda: torch.func.hessian(smooth(fails, S))(X)):
        with pytest.raises(KeyError, match="my own"):
            call()


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
@pytest.mark.parametrize(
    ("of_one_point", "error"),
    [
        (lambda z: float(z[0]) ** 2, ValueError),
        (lambda z: z.sum().item() if z[0] > 0 else 0.0, RuntimeError),
        (lambda z: math.sin(z.numpy()[0]), TypeError),
        (lambda z: np.linspace(0.0, 1.0, 3)[z.int()[0, 0] + 7], IndexError),
    ],
)
def test_an_error_of_the_first_batch_says_that_it_was_one(of_one_point, error: type[Exception]) -> None:
    for call in (lambda: estimate(of_one_point, X, S), lambda: torch.func.grad(smooth(of_one_point, S))(X)):
        with pytest.raises(error) as raised:
            call()
        note = "fn was called with a batch [7, 2]; if it takes one point, pass vectorized=False"
        assert raised.value.__notes__ == [note]
    with pytest.raises(error) as raised:
        estimate(lambda z: of_one_point(z[None].expand(4, 2)), X, S, vectorized=False)
    assert not hasattr(raised.value, "__notes__")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
@pytest.mark.parametrize("vectorized", [True, False])
def test_an_error_of_arrays_and_tensors_says_how_to_make_an_array(vectorized: bool) -> None:
    with pytest.raises(TypeError, match="numpy") as raised:
        estimate(lambda z: (np.ones(2) - z[..., 0]).sum(), X, S, vectorized=vectorized)
    points = "points" if vectorized else "a point"
    assert raised.value.__notes__[0] == f"fn gets {points} as a torch.Tensor: np.asarray(x) is the array"


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
@pytest.mark.parametrize("vectorized", [True, False])
def test_the_note_says_that_fn_gets_points_alone_where_there_is_a_head(vectorized: bool) -> None:
    layer = BlackBox(lambda z, r: z - r, S, head=heads.SquaredError(), vectorized=vectorized)
    with pytest.raises(TypeError, match="missing 1 required positional argument") as raised:
        layer(torch.zeros(3, 2), torch.ones(3, 2))
    assert raised.value.__notes__ == ["fn gets points alone where there is a head: the head gets the auxiliary inputs"]


@pytest.mark.parametrize("number", [np.float32(2.5), np.int64(2), torch.tensor(1e6), 3])
def test_any_number_may_replace_what_is_not_finite(number) -> None:
    given = BlackBox(lambda z: z.sum(1) * math.nan, S, on_nonfinite=number)
    assert given(torch.zeros(3, 2)).tolist() == [float(number)] * 3


CALLED = "fn was called as fn(points [7, 2]"


class Batches:
    """A black box that takes batches by construction, and fails."""

    takes_batches = True

    def __init__(self, error: type[Exception] = ValueError) -> None:
        self.error = error

    def __call__(self, z: Tensor, *aux: Tensor) -> Tensor:
        raise self.error("no such scene")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
@pytest.mark.parametrize(
    ("fn", "aux", "notes"),
    [
        (lambda z: torch.autograd.grad(z.square().sum(), z)[0], [], ["fn is called under torch.no_grad(): compute"]),
        (lambda z: squares(z), [torch.ones(3)], [f"{CALLED}, aux [7, 3])"]),
        (lambda z, y, w: squares(z), [torch.ones(3)], [f"{CALLED}, aux [7, 3])"]),
        (lambda z, y: squares(z), [], [f"{CALLED})"]),
        (lambda z: (lambda a, b: a)(*z), [], [f"{CALLED}); if it takes one point, pass vectorized=False"]),
        (Batches(), [], []),
        (Batches(TypeError).__call__, [], []),
        (Factory(Batches), [], []),
    ],
    ids=["derivatives", "no aux", "two aux", "one aux", "inside", "batches", "method", "factory"],
)
def test_the_note_says_how_fn_was_called(fn, aux: list[Tensor], notes: list[str]) -> None:
    with pytest.raises((TypeError, RuntimeError, ValueError)) as raised:
        BlackBox(fn, S)(X.clone().requires_grad_(), *aux)
    found = getattr(raised.value, "__notes__", [])
    assert len(found) == len(notes)
    for note, start in zip(found, notes, strict=True):
        assert note == start or (start.endswith("compute") and note.startswith(start))


def test_ready_black_boxes_take_batches() -> None:
    assert all(one.takes_batches for one in (MitsubaScene, OnnxFunction, Program))


def test_an_error_of_a_later_batch_has_no_note() -> None:
    calls = []

    def fn(z: Tensor) -> Tensor:
        calls.append(z)
        if len(calls) == 2:
            raise ValueError("lost the scene")
        return squares(z)

    layer = BlackBox(fn, S)
    layer(X)
    with pytest.raises(ValueError, match="lost the scene") as raised:
        layer(X)
    assert not hasattr(raised.value, "__notes__")


def test_the_function_cannot_change_its_input() -> None:
    x = X.clone()

    def greedy(z: Tensor) -> Tensor:
        result = squares(z)
        z.zero_()
        return result

    with torch.no_grad():
        BlackBox(greedy, S)(x)
    got, expected = estimate(greedy, x, S.replace(baseline="none"), value="smoothed"), estimate(squares, X, S)
    assert torch.equal(x, X)
    assert torch.equal(got.points, expected.points[:-1])


OTHERS = [
    (lambda: estimate(squares, X, S.replace(sigma=torch.ones(3))), ValueError, "sigma has 3 elements, but x has 2"),
    (lambda: estimate(squares, X, S.replace(sigma=torch.ones(1))), ValueError, "sigma has 1 elements, but x has 2"),
    (lambda: BlackBox(squares, 0.5), TypeError, "smoothing must be a Smoothing, got float"),
    (lambda: estimate(squares, X, 0.5), TypeError, "smoothing must be a Smoothing, got float"),
    (lambda: BlackBox("f", S), TypeError, "fn must be callable, got 'f'"),
    (lambda: estimate(None, X, S), TypeError, "fn must be callable, got None"),
    (lambda: BlackBox(squares, S, value="mean"), ValueError, "value must be 'center' or 'smoothed', got 'mean'"),
    (
        lambda: BlackBox(squares, S, on_nonfinite="skip"),
        ValueError,
        "on_nonfinite must be 'raise', 'drop' or a finite number, got",
    ),
    (lambda: BlackBox(squares, S, on_nonfinite=True), TypeError, "on_nonfinite must be .*got True"),
    (lambda: BlackBox(squares, S, on_nonfinite=None), TypeError, "'raise', 'drop' or a finite number, got None"),
    (lambda: BlackBox(squares, S, on_nonfinite=math.inf), ValueError, "'raise', 'drop' or a finite number, got inf"),
    (lambda: estimate(squares, X, S, 1.0), TypeError, r"aux\[0\] must be a tensor \[\*batch, \.\.\.\], got float"),
    (
        lambda: estimate(lambda z, a: squares(z), X.expand(3, 2), S, torch.ones(2)),
        ValueError,
        r"aux\[0\] must have the batch dimensions \[3\] of x first, got \[2\]",
    ),
    (lambda: estimate(squares, X, S).hvp(torch.ones(3)), ValueError, r"v must be a tensor of shape \[2\], got \[3\]"),
    (lambda: estimate(squares, X, S).hvp([1.0, 2.0]), ValueError, r"v must be a tensor of shape \[2\], got list"),
    (lambda: estimate(squares, X, S).standard_error("slope"), ValueError, "quantity must be 'value', .*got 'slope'"),
    (lambda: estimate(squares, X, S).standard_error("hvp"), ValueError, "v is the vector of quantity 'hvp'"),
    (lambda: estimate(squares, X, S).standard_error("value", X), ValueError, "v is the vector of quantity 'hvp'"),
    (lambda: estimate(squares, X, ONE).standard_error("value"), ValueError, "at least two independent draws"),
    (
        lambda: estimate(squares, X, ONE.replace(proposal="optimal")).standard_error("value"),
        ValueError,
        "at least 2 independent draws per element, got 1: use at least 2 samples, with sampler 'sobol' an even number",
    ),
    (
        lambda: estimate(squares, X, ONE.replace(proposal="optimal", samples=3, sampler="sobol")).standard_error(
            "value"
        ),
        ValueError,
        "at least 2 independent draws per element, got 1: .* 'sobol' an even number",
    ),
    (
        lambda: estimate(lambda z: squares(z) * torch.where(z[:, 0] == X[0], 1.0, math.nan), X, S, on_nonfinite="drop"),
        ValueError,
        "on_nonfinite='drop' left 0 of 3 draws, 1 are needed",
    ),
    (
        lambda: estimate(squares, torch.zeros(30_000), S.replace(sampler="sobol")),
        ValueError,
        "sampler 'sobol' has .* dimensions at most, but x has 30000 parameters: use 'random'",
    ),
]


@pytest.mark.parametrize("value", ["center", "smoothed"])
def test_a_sigma_of_another_length_is_refused_without_gradients_too(value: str) -> None:
    layer = BlackBox(squares, S.replace(sigma=torch.ones(3)), value=value)
    for x in (X, X.clone().requires_grad_()):
        with pytest.raises(ValueError, match="sigma has 3 elements, but x has 2 parameters"):
            layer(x)
    with torch.no_grad(), pytest.raises(ValueError, match="sigma has 3 elements, but x has 2 parameters"):
        layer(X.clone().requires_grad_())


@pytest.mark.parametrize(("call", "error", "message"), OTHERS)
def test_other_arguments(call, error: type[Exception], message: str) -> None:
    with pytest.raises(error, match=message):
        call()


def test_optimal_sampling_stops_at_a_million_evaluations() -> None:
    """1 + n + n (n + 1) / 2 = 6 sets of pairs for two parameters."""
    most = S.replace(proposal="optimal", samples=83_333)
    assert estimate(squares, X, most).evaluations == 999_996 + 1
    message = "would need 1000008 evaluations for 1 x 2 .* at most 1000000 .* use proposal 'aggregate'"
    with pytest.raises(ValueError, match=message):
        estimate(squares, X, most.replace(samples=83_334))
    assert most.replace(samples=3).evaluations(1000, center=False) == 3_009_006


FIRST_ORDER = "first derivatives only .*use Smoothing\\(proposal='aggregate', order=2\\)"


@pytest.mark.parametrize("changes", [{"proposal": "fr22"}, {"proposal": "optimal", "order": 1}])
def test_first_order_samples_have_no_hessian(changes: dict) -> None:
    smoothing = S.replace(**changes)
    e, layer, x = estimate(squares, X, smoothing), smooth(squares, smoothing), X.clone().requires_grad_()

    def double_backward() -> None:
        (gradient,) = torch.autograd.grad(layer(x), x, create_graph=True)
        torch.autograd.grad(gradient.sum(), x)

    asked = [
        e.hessian,
        e.hessian_diagonal,
        lambda: e.hvp(X),
        lambda: e.standard_error("hvp", X),
        lambda: e.standard_error("hessian_diagonal"),
        lambda: torch.func.hessian(layer)(X),
        lambda: torch.func.jacrev(torch.func.jacrev(layer))(X),
        lambda: torch.autograd.functional.hessian(layer, X),
        lambda: torch.autograd.functional.hvp(layer, X, X),
        double_backward,
    ]
    for ask in asked:
        with pytest.raises(ValueError, match=FIRST_ORDER):
            ask()


@pytest.mark.parametrize(
    ("dtype", "sigma", "hint"),
    [(torch.float32, 1e-7, "float64"), (torch.float64, 1e-16, "shift"), (torch.float32, 0.35 * 2.0**-17, "float64")],
)
def test_sigma_below_the_rounding_of_x(dtype: torch.dtype, sigma: float, hint: str) -> None:
    """Numbers of float32 near 100 are 2^-17 apart. With a third of that, the gradient would be a fifth too small."""
    x = torch.tensor([0.0, 100.0], dtype=dtype)
    message = rf"sigma is below the rounding of x: x \+ sigma\*u == x .*parameter 1, x = 100\.0, sigma = .*{hint}"
    for call in (
        lambda: estimate(squares, x, S.replace(sigma=sigma)),
        lambda: BlackBox(squares, S.replace(sigma=sigma)).freeze(x),
    ):
        with pytest.raises(ValueError, match=message):
            call()


def test_sigma_below_the_smallest_number() -> None:
    with pytest.raises(ValueError, match=r"sigma is below the rounding of x: .* x = 0\.0, sigma = 1e-46"):
        estimate(squares, torch.zeros(2), S.replace(sigma=1e-46))


@settings(deadline=None, derandomize=True, max_examples=150)
@given(
    sigma=st.floats(),
    samples=st.integers(-2, 20),
    seed=st.one_of(st.none(), st.integers(-(2**64), 2**64)),
    order=st.integers(-1, 4),
)
def test_a_setting_is_accepted_or_refused_by_its_stated_range(
    sigma: float, samples: int, seed: int | None, order: int
) -> None:
    right = sigma > 0 and math.isfinite(sigma) and samples >= 1 and order in (1, 2)
    right = right and (seed is None or 0 <= seed < 2**63)
    if right:
        smoothing = Smoothing(sigma=sigma, samples=samples, seed=seed, order=order)
        assert smoothing.sigma == sigma
        assert smoothing.evaluations(3) == 2 * samples + 1
    else:
        with pytest.raises(ValueError, match=r"(sigma|samples|seed|order) must"):
            Smoothing(sigma=sigma, samples=samples, seed=seed, order=order)


@settings(deadline=None, derandomize=True, max_examples=150)
@given(
    batch=st.lists(st.integers(1, 3), max_size=2),
    n=st.integers(1, 6),
    out=st.lists(st.integers(1, 3), max_size=2),
    samples=st.integers(2, 5),
    proposal=st.sampled_from(["aggregate", "gaussian", "optimal", "uniform"]),
    baseline=st.sampled_from(["center", "mean", "none"]),
    antithetic=st.booleans(),
    single=st.booleans(),
    seed=st.integers(0, 2**63 - 1),
)
def test_shapes_symmetry_and_linearity(
    batch: list[int], n: int, out: list[int], samples: int, proposal: str, baseline: str, antithetic: bool,
    single: bool, seed: int,
) -> None:  # fmt: skip
    n = min(n, 3) if proposal == "uniform" else n
    smoothing = Smoothing(
        sigma=0.3, samples=samples, proposal=proposal, baseline=baseline, antithetic=antithetic, seed=seed
    )
    dtype = torch.float32 if single else torch.float64
    x = spread(math.prod(batch) * n, -1.0, 1.0).to(dtype).reshape(*batch, n)
    scale = spread(math.prod(out), 0.5, 2.0).reshape(out)

    def fn(z: Tensor) -> Tensor:
        return torch.cos(z.double().sum(1)).reshape(-1, *[1] * len(out)) * scale

    one = estimate(lambda z: torch.cos(z.double().sum(1)), x, smoothing, value="smoothed")
    e = estimate(fn, x, smoothing, value="smoothed")
    shape = (*batch, *out)
    assert e.value.shape == shape
    assert e.gradient.shape == e.hessian_diagonal().shape == (*shape, n)
    assert e.hessian().shape == (*shape, n, n)
    assert torch.equal(e.hessian(), e.hessian().mT)
    assert e.evaluations == math.prod(batch) * smoothing.evaluations(n, center=baseline == "center")
    # The estimate is linear in f: each output is its scale times the one function.
    expected = one.gradient.reshape(*batch, *[1] * len(out), n) * scale[..., None]
    tolerance = 1e-5 if single else 1e-12
    torch.testing.assert_close(e.gradient.double(), expected.double(), rtol=tolerance, atol=tolerance)


def test_an_x_that_is_not_finite_is_named_before_fn_is_called() -> None:
    def never(z: torch.Tensor) -> torch.Tensor:
        raise AssertionError("fn was called")

    x = torch.tensor([1.0, math.nan])
    for call in (lambda: BlackBox(never, S)(x), lambda: BlackBox(never, S)(x.requires_grad_())):
        with pytest.raises(ValueError, match="x must be finite, got nan for parameter 1"):
            call()


@pytest.mark.parametrize("call", [BlackBox(squares, S), lambda x: estimate(squares, x, S), SparseBlackBox(squares, S)])
def test_an_x_without_numbers_is_refused(call) -> None:
    with pytest.raises(TypeError, match="x must have numbers, got a tensor on the device meta"):
        call(torch.ones(2, device="meta"))


def test_a_sparse_x_is_refused() -> None:
    with pytest.raises(TypeError, match=r"x must be dense, got torch\.sparse_coo: convert by x\.to_dense\(\)"):
        estimate(squares, torch.ones(2).to_sparse(), S)


@pytest.mark.parametrize("layout", [torch.strided, torch.jagged])
@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors is in prototype stage")
def test_nested_tensors_are_refused_by_name(layout: torch.layout) -> None:
    nested = torch.nested.nested_tensor([torch.ones(2, 3), torch.ones(1, 3)], layout=layout)
    with pytest.raises(TypeError, match="x must be one dense tensor, got a nested tensor: pass its parts one by one"):
        estimate(squares, nested, S)
    with pytest.raises(TypeError, match=r"aux\[0\] must be one dense tensor, got a nested tensor"):
        BlackBox(lambda z, _: squares(z), S)(torch.ones(2, 3), nested)


def test_a_symbolic_trace_says_what_to_do() -> None:
    with pytest.raises(TypeError, match=r"got Proxy: torch\.fx cannot trace a black box, make its layer a leaf module"):
        torch.fx.symbolic_trace(BlackBox(squares, S))


def test_an_executor_is_no_evaluator() -> None:
    with (
        concurrent.futures.ThreadPoolExecutor(1) as threads,
        pytest.raises(TypeError, match=r"evaluator must be callable: write torch_zerohess\.evaluators\.Executor"),
    ):
        estimate(squares, X, S, evaluator=threads)


def test_uniform_samples_of_which_none_counts_warn() -> None:
    """(E w)^2 / E w^2 of w = N / p is (sqrt(pi) / 5)^n for a box of 5 sigma: one in 63.3 samples with four parameters.

    With 64 samples and 20 parameters a gradient of norm 8.9 is 1e-4, and so is its standard error.
    """
    few, enough = (S.replace(proposal="uniform", samples=samples) for samples in (63, 64))
    layer, x = BlackBox(squares, few), torch.ones(4)
    compiled = torch.compile(layer, fullgraph=True, backend="eager") if tracing.GRAPHS else layer
    for call in (
        lambda: estimate(squares, x, few),
        lambda: layer(x.clone().requires_grad_()),
        lambda: compiled(x.clone().requires_grad_()),
        lambda: torch.func.hessian(layer)(x),
        lambda: estimate(squares, torch.ones(20), enough),
    ):
        with pytest.warns(UserWarning, match=r"'uniform' with \d+ parameters needs at least 2\.82\^\d+ samples, got 6"):
            call()
    estimate(squares, x, enough)
    estimate(squares, torch.ones(3), enough.replace(samples=1))
