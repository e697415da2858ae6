"""A loss that is written for something else than one output is named, with what it was given."""

import numpy as np
import pytest
import torch
from torch import Tensor

import torch_zerohess as zh

LINE = torch.linspace(0, 1, 16).double()


def image(z: Tensor) -> Tensor:
    return (LINE * z[:, :1] + z[:, 1:].square()).view(-1, 4, 4)


GIVEN = r"loss gets one float64 output of shape \[4, 4\], not a batch, and must compute with torch; it raised "
RAISED = {
    "a batch": (lambda y: y.square().mean((1, 2)), IndexError, "IndexError: Dimension out of range"),
    "another axis": (lambda y: y.square().sum(2).sum(), IndexError, "IndexError: Dimension out of range"),
    "another shape": (lambda y: (y - LINE).square().sum(), RuntimeError, "RuntimeError: The size of tensor a"),
    "an image of another shape": (zh.losses.mse(LINE.view(2, 8)), ValueError, "ValueError: image must be"),
    "another type": (lambda y: (y @ torch.ones(4)).sum(), RuntimeError, "RuntimeError: .* dtype"),
    "two arguments": (lambda y, target: (y - target).sum(), TypeError, "TypeError: .* missing 1 required positional"),
    "an array": (lambda y: y.astype(float).sum(), AttributeError, "AttributeError: 'Tensor' object has no"),
    "an array that is differentiated": (
        lambda y: torch.tensor(np.square(np.asarray(y)).sum()),
        RuntimeError,
        r"RuntimeError: Can't call numpy\(\) on Tensor that requires grad",
    ),
}
RETURNED = {
    "losses of rows": (lambda y: y.square().flatten(1).mean(1), ValueError, r"a scalar, got shape \[4\]"),
    "nothing": (lambda y: y[:0], ValueError, r"a scalar, got shape \[0, 4\]"),
    "a float": (
        lambda y: float(y.sum()),
        TypeError,
        "a tensor, which torch differentiates, got float",
    ),
    "an array": (lambda y: np.square(y.numpy()).sum(), TypeError, "a tensor, which torch differentiates, got float64"),
}


@pytest.mark.parametrize("engine", ["descent", "gaussian_process", "local"])
@pytest.mark.parametrize("case", RAISED)
def test_what_a_loss_raises_that_cannot_take_one_output(case, engine) -> None:
    loss, kind, message = RAISED[case]
    with pytest.raises(kind, match=GIVEN + message) as caught:
        zh.minimize(image, [0.7, 0.2], sigma=0.3, bounds=(0, 1), loss=loss, engine=engine, seed=0)
    assert type(caught.value.__cause__) is type(caught.value) is kind
    assert "loss gets" not in str(caught.value.__cause__)


@pytest.mark.parametrize("case", RETURNED)
def test_what_a_loss_returns_that_is_no_scalar(case) -> None:
    loss, kind, message = RETURNED[case]
    search = zh.optim.TrustRegion([0.7, 0.2], sigma=0.3, loss=loss, seed=0)
    points = search.ask()
    with pytest.raises(kind, match=f"loss must return {message} for one output of shape \\[4, 4\\]"):
        search.tell(image(points))


def test_a_complex_loss() -> None:
    with pytest.raises(TypeError, match="loss must return a real number, got torch"):
        zh.minimize(image, [0.7, 0.2], sigma=0.3, loss=lambda y: torch.fft.fft(y).sum())


@pytest.mark.parametrize("graph", [False, True])
def test_errors_of_a_loss_that_has_returned_values_are_the_callers_own(graph) -> None:
    """So are errors of any other type, also in the first call."""
    calls, own = [], ValueError("the own one")

    def loss(y):
        calls.append(y.requires_grad)
        if y.requires_grad == graph and calls.count(graph) == 2:
            raise own
        return y.square().sum()

    with pytest.raises(ValueError, match="the own one") as caught:
        zh.minimize(image, [0.7, 0.2], sigma=0.3, loss=loss, seed=0)
    assert caught.value is own

    class OwnError(ValueError):
        pass

    def other(y):
        raise OwnError

    with pytest.raises(OwnError, match=r"^$"):
        zh.minimize(image, [0.7, 0.2], sigma=0.3, loss=other, seed=0)


def test_where_a_loss_belongs_that_torch_cannot_compute() -> None:
    search = zh.optim.TrustRegion([0.7, 0.2], sigma=0.3, loss=lambda y: float(y.sum()), seed=0)
    with pytest.raises(TypeError, match="that torch cannot compute belongs in the black box"):
        search.tell(image(search.ask()))
