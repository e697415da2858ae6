"""A warning where values of fn differ by little more than their rounding, and none where a function has steps."""

import warnings

import pytest
import torch

import torch_zerohess as zh
from torch_zerohess.estimation.rounding import RoundingCheck, _spacing, warning_of

SMOOTHING = zh.Smoothing(sigma=1.0, samples=8, seed=0)
ROUNDED = "around x (are equal|differ by little more than rounding)"


def gradient(fn, *, x=None, smoothing=SMOOTHING, **settings):
    x = (torch.zeros(4) if x is None else x).requires_grad_()
    (g,) = torch.autograd.grad(zh.BlackBox(fn, smoothing, **settings)(x).sum(), x)
    return g


def unsaid(call):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return call()


@pytest.mark.parametrize(("offset", "slope"), [(1e8, 1.0), (1e6, 0.03), (1.0, 3e-8)])
def test_a_large_offset_in_float32_is_told(offset, slope):
    """The rounded gradient is far from the slope; computed in float64 nothing is said, and it is the slope.

    The standard error of the gradient of a linear function from 2 000 pairs is 0.045 slopes at most.
    """
    many = SMOOTHING.replace(samples=2000)
    with pytest.warns(UserWarning, match=ROUNDED):
        wrong = gradient(lambda z: offset + slope * z.sum(1), smoothing=SMOOTHING.replace(sigma=0.3))
    assert float((wrong / slope - 1).abs().max()) > 0.5
    right = unsaid(lambda: gradient(lambda z: offset + slope * z.double().sum(1), smoothing=many))
    torch.testing.assert_close(right / slope, torch.ones(4), rtol=0.0, atol=0.23)
    centred = unsaid(lambda: gradient(lambda z: slope * z.sum(1), smoothing=many))
    torch.testing.assert_close(centred / slope, torch.ones(4), rtol=0.0, atol=0.23)


def test_an_estimate_tells_it_too():
    with pytest.warns(UserWarning, match=r"are equal.* float32 lie 8 apart at 1e\+08\. If fn varies by less"):
        zh.estimate(lambda z: 1e8 + z.sum(1), torch.zeros(4), SMOOTHING.replace(sigma=0.1))
    with pytest.warns(UserWarning, match=r"differ by little.* float32 lie 0\.0625 apart at 1e\+06\. Compute fn"):
        zh.estimate(lambda z: 1e6 + 0.015 * z.sum(1), torch.zeros(4), SMOOTHING)


FLAT = {
    "a plateau": lambda z: torch.full_like(z[:, 0], 0.3),
    "a plateau of zeros": lambda z: 0.0 * z[:, 0],
    "a plateau of a million": lambda z: 1e6 + 0.0 * z[:, 0],
    "a step": lambda z: (z[:, 0] > 0.5).float(),
    "a small step on an offset": lambda z: 1.0 + 1e-6 * (z[:, 0] > 0),
    "rounding": lambda z: z.round().square().sum(1),
    "a count of millions": lambda z: 5_000_000 + z[:, 0].round(),
    "an image with an empty background": lambda z: (torch.arange(16.0) - z[:, :1]).abs().lt(2).float(),
    "an image of which one pixel is rounded": lambda z: torch.stack([1e8 + z[:, 0], z[:, 1]], 1),
    "a jump to infinity that is replaced": lambda z: torch.where(z[:, 0] > 0, torch.inf, 1e8 + z[:, 0]),
}


@pytest.mark.parametrize("name", FLAT)
@pytest.mark.parametrize("sigma", [0.01, 0.5])
def test_functions_with_steps_are_left_alone(name, sigma):
    smoothing = SMOOTHING.replace(sigma=sigma)
    unsaid(lambda: gradient(FLAT[name], smoothing=smoothing, on_nonfinite=0.0))
    unsaid(lambda: zh.estimate(FLAT[name], torch.full((3, 4), 0.5), smoothing, on_nonfinite=0.0))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_spacings_are_known_for_all_magnitudes(dtype):
    """Against the next number by bits: that of an int16 or int32 is the next float."""
    size = torch.cat([torch.zeros(1), torch.logspace(-45, 38, 400)]).to(dtype)
    size = size[size < torch.finfo(dtype).max]
    bits = size.view(torch.int32 if dtype == torch.float32 else torch.int16)
    expected = (bits + 1).view(dtype).double() - size.double()
    assert torch.equal(_spacing(size.double(), dtype), expected)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_spacings_are_those_of_the_type(dtype):
    """Values of 3 and the number above it are two numbers of the type that lie beside each other; 4 and 7 are not."""
    above = 3 * (1 + torch.finfo(dtype).eps)
    near, far = torch.tensor([[3.0, 3.0, above, 3.0] * 2]), torch.tensor([[4.0, 7.0] * 4])
    assert len(set(near.to(dtype).flatten().tolist())) == 2
    assert "differ by little" in warning_of(near.to(dtype))
    assert not warning_of(far.to(dtype))


def test_one_element_of_a_batch_with_resolved_values_is_enough():
    rounded = torch.tensor([1.0, 1.0 + 2**-23] * 4)
    assert warning_of(rounded[None])
    assert not warning_of(torch.stack([rounded, torch.linspace(0, 1, 8)]))


def test_few_values_may_be_close_by_chance():
    rounded = torch.tensor([[1.0, 1.0 + 2**-23, 1.0]])
    assert not warning_of(rounded)
    assert warning_of(rounded.expand(3, -1))


def test_a_layer_tells_it_once_and_also_after_many_calls():
    """As where sigma was lowered: at the latest when the calls have doubled."""
    layer, x = zh.BlackBox(lambda z: 1e6 + z.sum(1), SMOOTHING), torch.zeros(4, requires_grad=True)
    for _ in range(5):
        unsaid(lambda: layer(x).backward())
    layer.smoothing = layer.smoothing.replace(sigma=0.02)
    for call in range(6, 40):
        if call == 8:
            with pytest.warns(UserWarning, match=ROUNDED):
                layer(x).backward()
        else:
            unsaid(lambda: layer(x).backward())
    with pytest.warns(UserWarning, match=ROUNDED):
        gradient(lambda z: 1e8 + z.sum(1), smoothing=SMOOTHING.replace(sigma=0.1))  # another layer


def test_most_calls_are_not_looked_at():
    """A look at 17 values takes a tenth of a small forward and backward pass."""
    looked = []

    class Watched(torch.Tensor):
        def detach(self):
            looked.append(True)
            return super().detach()

    check, values = RoundingCheck(), torch.randn(1, 17).as_subclass(Watched)
    for _ in range(100):
        check(values)
    assert len(looked) == 7  # calls 1, 2, 4, ..., 64


@pytest.mark.filterwarnings("ignore:values of fn at the 17 points:UserWarning")
def test_transforms_and_compiled_code_have_their_result():
    layer = zh.BlackBox(lambda z: 1e8 + z.sum(1), SMOOTHING.replace(sigma=0.1))
    x = torch.zeros(3, 2)
    assert torch.equal(torch.func.vmap(torch.func.grad(layer))(x), x)
    assert torch.equal(torch.func.vmap(torch.func.hessian(layer))(x), torch.zeros(3, 2, 2))
    compiled = torch.compile(layer, fullgraph=True, backend="aot_eager")
    x.requires_grad_()
    compiled(x).sum().backward()
    assert torch.equal(x.grad, torch.zeros(3, 2))
