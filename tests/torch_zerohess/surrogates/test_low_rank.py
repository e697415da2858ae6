"""Coordinates of outputs, and a surrogate through them, against the outputs themselves."""

import pytest
import torch

from torch_zerohess.surrogates.gaussian_process_surrogate import ProcessSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.low_rank import LowRank, LowRankSurrogate
from truths import normal


def of_rank(rank, P=30, seed=0):
    """Outputs [P, 4, 10] whose differences span `rank` dimensions."""
    return (normal(P, rank, seed=seed) @ normal(rank, 40, seed=9) + normal(40, seed=8)).unflatten(1, (4, 10))


def test_outputs_in_the_span_are_their_coordinates():
    outputs, others = of_rank(5), of_rank(5, 7, seed=1)
    space = LowRank.of(outputs, 12)
    coordinates = space.encode(others)
    assert coordinates.shape == (7, 5)  # no more than there are dimensions
    torch.testing.assert_close(space.decode(coordinates), others)
    expected = (others[:, None] - outputs).square().mean((2, 3))
    found = (coordinates[:, None] - space.encode(outputs)).square().sum(2)
    torch.testing.assert_close(found, expected)


@pytest.mark.parametrize("size", [1e-30, 1e25])
def test_outputs_of_any_size(size):
    outputs, others = of_rank(5).float(), of_rank(5, 7, seed=1).float()
    space = LowRank.of(outputs * size, 12)
    torch.testing.assert_close(space.decode(space.encode(others * size)) / size, others, rtol=1e-3, atol=1e-3)


def test_the_span_is_that_of_rank_outputs_and_the_projection_orthogonal():
    outputs = normal(30, 40)
    space = LowRank.of(outputs, 6)
    assert space.basis.shape == (40, 6)
    torch.testing.assert_close(space.basis.mT @ space.basis, torch.eye(6).double() / 40)
    left = outputs - space.decode(space.encode(outputs))
    torch.testing.assert_close(left @ space.basis, torch.zeros(30, 6).double(), atol=1e-12, rtol=0)
    assert int((left.square().sum(1) < 1e-20).sum()) == 6  # those that span it


def test_the_same_outputs_have_the_same_coordinates():
    outputs = normal(30, 40)
    torch.manual_seed(1)
    first = LowRank.of(outputs, 6)
    torch.manual_seed(2)
    assert torch.equal(LowRank.of(outputs, 6).basis, first.basis)


def test_directions_in_rounding_are_left_out():
    """Of float32 outputs that span two dimensions, not four million times their smallest difference."""
    outputs = (100 * normal(20, 2) @ normal(2, 40, seed=1)).float()
    space = LowRank.of(outputs, 20)
    assert space.basis.shape[1] == 2


def test_equal_outputs_have_one_direction():
    space = LowRank.of(torch.ones(5, 3), 4)
    assert torch.equal(space.encode(torch.ones(2, 3)), torch.zeros(2, 1))
    torch.testing.assert_close(space.basis.mT @ space.basis, torch.eye(1) / 3)


def test_a_weak_direction_is_kept():
    """One whose variance is 1e-6 of the largest."""
    outputs = normal(30, 2) @ torch.diag(torch.tensor([1.0, 2e-3]).double()) @ normal(2, 40, seed=1)
    assert LowRank.of(outputs, 20).basis.shape[1] == 2


@pytest.mark.parametrize("make", [ProcessSurrogate, LinearSurrogate])
def test_a_prediction_through_coordinates_is_the_full_one_where_the_rank_suffices(make):
    points = 2 * normal(30, 2)
    outputs = (torch.sin(points @ normal(2, 3, seed=2)) @ normal(3, 40, seed=3)).unflatten(1, (4, 10))
    full, low = make(), LowRankSurrogate(make(), rank=10)
    full.fit(points, outputs)
    low.fit(points, outputs)
    z = normal(9, 2, seed=4)
    assert low(z).shape == (9, 4, 10)
    assert low.coordinates(z).shape == (9, 3)
    torch.testing.assert_close(low(z), full(z), atol=1e-4, rtol=0)
    one, other = (torch.func.jacrev(model)(z[:1]) for model in (low, full))
    torch.testing.assert_close(one, other, atol=1e-3, rtol=0)


def test_the_latest_points_are_kept_and_types_are_those_of_the_inputs():
    points, outputs = normal(30, 2).float(), of_rank(2).float()
    outputs[:20] = 100.0
    model = LowRankSurrogate(LinearSurrogate(), rank=8, capacity=10)
    model.fit(points, outputs)
    assert float(model.space.mean.abs().max()) < 50.0
    assert model(points).dtype == torch.float32


def test_numbers_are_outputs_too():
    points = normal(30, 2)
    numbers = points @ torch.tensor([1.0, -2.0], dtype=points.dtype)
    model = LowRankSurrogate(LinearSurrogate(), rank=8)
    model.fit(points, numbers)
    torch.testing.assert_close(model(points), numbers, atol=1e-4, rtol=0)


def test_what_is_wrong_is_said():
    with pytest.raises(ValueError, match="rank must be at least 1, got 0"):
        LowRankSurrogate(LinearSurrogate(), rank=0)
    with pytest.raises(RuntimeError, match="fit the surrogate"):
        LowRankSurrogate(LinearSurrogate()).space  # noqa: B018


@pytest.mark.parametrize("size", [1.0, 1e4])
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_coordinates_of_half_precision_have_its_rounding_alone(dtype, size) -> None:
    """Sums of squares of values of 1e4 are beyond float16."""
    images = size * normal(40, 3) @ normal(3, 200, seed=1) / 4.0
    half = images.to(dtype)
    space = LowRank.of(half, 40)
    again = space.decode(space.encode(half))
    assert float((again - images).norm()) < torch.finfo(dtype).eps * float(images.norm())
