"""Two quadratics, the larger of which fits values on both sides of a kink."""

import pytest
import torch
from torch import Tensor

from torch_zerohess.linalg.larger_of_two import two_values
from torch_zerohess.surrogates.two_sides import fit_two_sides


def random(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def normal(generator: torch.Generator, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=generator, dtype=torch.float64)


def fitted(u: Tensor, values: Tensor, at: Tensor) -> Tensor:
    matrices = fit_two_sides(u, values)
    assert matrices is not None
    return two_values(matrices, at).amax(0)


@pytest.mark.parametrize("steep", [1.0, 1e4])
@pytest.mark.parametrize("n", [1, 2, 5])
def test_both_sides_of_a_penalty_are_found(n: int, steep: float) -> None:
    """On every one of six seeds the fit predicts values at points that it was not given."""
    for seed in range(6):
        generator = random(seed)
        direction, bend = torch.nn.functional.normalize(normal(generator, n), dim=0), normal(generator, n)

        def f(u: Tensor, direction: Tensor = direction, bend: Tensor = bend) -> Tensor:
            return u.square() @ bend + steep * (2 * u @ direction - 0.3 + u[:, 0].square()).clamp(min=0)

        u, others = (normal(generator, count, n) / n**0.5 for count in (4 * (n + 1) * (n + 2), 50))
        assert float((fitted(u, f(u), others) - f(others)).abs().max()) < 1e-4 * steep


def test_sides_that_are_equally_high_are_told_apart() -> None:
    """High and low values are on both sides here."""
    for seed in range(6):
        u, others = (normal(random(seed + k), 30, 2) for k in (0, 50))
        norm = torch.tensor([0.6, 0.8]).double()
        assert torch.allclose(fitted(u, (u @ norm).abs(), others), (others @ norm).abs(), atol=1e-6)


def test_a_side_inside_of_a_ring_is_found() -> None:
    """No plane lies between the sides."""
    for seed in range(6):
        u, others = (normal(random(seed + k), 60, 2) for k in (0, 50))

        def f(u: Tensor) -> Tensor:
            return u[:, 0] + 30 * (u.square().sum(1) - 1).clamp(min=0)

        assert torch.allclose(fitted(u, f(u), others), f(others), atol=1e-5)


def test_near_values_count_more_than_far_ones() -> None:
    u = torch.cat([0.1 * normal(random(0), 20, 2), 3 * normal(random(1), 20, 2)])

    def f(u: Tensor) -> Tensor:
        return (u[:, 0] + u[:, 1].abs()).sin()

    near = 0.1 * normal(random(2), 50, 2)
    assert float((fitted(u, f(u), near) - f(near)).abs().max()) < 0.01


def test_few_values_tell_planes() -> None:
    """With fewer values than a quadratic has coefficients the second derivatives are as small as can be."""
    u = normal(random(0), 14, 3)
    matrices = fit_two_sides(u, torch.maximum(u[:, 0], -2 * u[:, 0] + u[:, 1]))
    assert matrices is not None
    assert float(matrices[:, 1:, 1:].abs().max()) < 1e-3


def test_too_few_values_tell_nothing() -> None:
    u = normal(random(0), 5, 2)
    assert fit_two_sides(u, u[:, 0].abs()) is None


def test_a_quadratic_is_its_own_larger_one() -> None:
    u, others = (normal(random(k), 30, 2) for k in (0, 1))
    assert torch.allclose(fitted(u, u.square().sum(1), others), others.square().sum(1), atol=1e-6)


def test_the_second_one_is_the_steeper_one() -> None:
    u = normal(random(0), 30, 2)
    for side in (u[:, 0], -u[:, 0]):
        matrices = fit_two_sides(u, u[:, 1] + 100 * side.clamp(min=0))
        assert matrices is not None
        assert matrices[:, 0, 1:].norm(dim=1).tolist() == pytest.approx([1.0, (1 + 1e4) ** 0.5], rel=1e-6)
