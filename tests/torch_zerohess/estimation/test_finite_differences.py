"""Products by finite differences against closed forms, and the settings of the source."""

import math

import pytest
import torch
from black_boxes import counting
from torch import Tensor

import torch_zerohess as zh
from truths import PlaneWave, vector

WAVE = PlaneWave(vector(0.9, -0.7, 1.1))


@pytest.mark.parametrize("common", [True, False])
@pytest.mark.parametrize("shape", ["one", "batch"])
def test_against_the_closed_form(common: bool, shape: str) -> None:
    """The step's own error is of second order, here below 3 %."""
    sigma, v = vector(0.4, 0.6, 0.5), vector(1.0, -2.0, 0.5)
    x = torch.tensor([[0.4, -0.2, 0.1], [0.0, 0.5, -0.3]], dtype=torch.float64)
    vectors = v if shape == "one" else v.expand(2, 3) * torch.tensor([[1.0], [-2.0]], dtype=torch.float64)
    smoothing = zh.Smoothing(sigma=sigma, samples=1 << 14, sampler="sobol", seed=1)
    found = zh.finite_difference_hvp(WAVE.f, x, vectors, smoothing, common=common)
    hessians = torch.func.vmap(torch.func.hessian(lambda z: WAVE.smoothed(z, sigma)))(x)
    expected = (hessians @ vectors.expand(2, 3)[..., None])[..., 0]
    assert (found - expected).abs().max() < 0.03 * expected.abs().max()


def points_of_two_gradients(v: Tensor, **settings) -> list[Tensor]:
    """Points [K, 2] at which the black box is called on either side, for sigma = (0.1, 0.4)."""
    called: list[Tensor] = []

    def fn(z: Tensor) -> Tensor:
        called.append(z.clone())
        return z.sum(1)

    smoothing = zh.Smoothing(sigma=vector(0.1, 0.4), samples=3, baseline="none", seed=5)
    zh.finite_difference_hvp(fn, vector(0.0, 0.0), v, smoothing, **settings)
    return called


@pytest.mark.parametrize(("settings", "length"), [({}, 1 / 3), ({"step": 0.2}, 0.2)])
def test_the_step_is_a_third_of_sigma_in_the_metric_of_sigma(settings: dict, length: float) -> None:
    v = vector(0.3, -0.8)
    forward, backward = points_of_two_gradients(v, **settings)
    offset = (forward.mean(0) - backward.mean(0)) / 2 / vector(0.1, 0.4)  # pairs have their mean at their x
    assert float(offset.norm()) == pytest.approx(length)
    torch.testing.assert_close(offset / offset.norm(), v / vector(0.1, 0.4) / (v / vector(0.1, 0.4)).norm())


def test_both_sides_use_the_same_perturbations_unless_they_are_not_to() -> None:
    for settings, same in (({}, True), ({"common": True}, True), ({"common": False}, False)):
        forward, backward = points_of_two_gradients(vector(1.0, 0.0), **settings)
        assert torch.allclose(forward - forward.mean(0), backward - backward.mean(0)) == same


def test_a_vector_that_is_not_finite_is_named() -> None:
    smoothing = zh.Smoothing(sigma=0.5, samples=4, seed=0)
    with pytest.raises(ValueError, match="v must be finite, got"):
        zh.finite_difference_hvp(lambda z: z.sum(1), torch.ones(2), vector(1.0, math.nan), smoothing)


def test_a_zero_vector_gives_zero() -> None:
    smoothing = zh.Smoothing(sigma=0.5, samples=4, seed=0)
    found = zh.finite_difference_hvp(lambda z: z.sum(1), torch.ones(3), torch.zeros(3), smoothing)
    assert torch.equal(found, torch.zeros(3))


def test_common_random_numbers_reduce_the_noise() -> None:
    x, v = torch.full((3,), 0.3, dtype=torch.float64), torch.ones(3, dtype=torch.float64)

    def scatter(common: bool) -> Tensor:
        products = [
            zh.finite_difference_hvp(WAVE.f, x, v, zh.Smoothing(sigma=0.5, samples=8, seed=s), common=common)
            for s in range(200)
        ]
        return torch.stack(products).std(0)

    assert bool((scatter(True) < scatter(False)).all())


def test_evaluators_and_values_that_are_not_finite() -> None:
    """Each side leaves out the pair in which the function has no value."""
    evaluator, calls = counting(lambda fn, points: fn(points))

    def square(z: Tensor) -> Tensor:
        return torch.where(z[:, 0] == z[:, 0].max(), torch.nan, z.square().sum(1))

    smoothing = zh.Smoothing(sigma=0.5, samples=8, baseline="mean", proposal="gaussian", sampler="orthogonal", seed=0)
    settings = {"evaluator": evaluator, "on_nonfinite": "drop"}
    found = zh.finite_difference_hvp(square, vector(0.3, -0.2), vector(1.0, 2.0), smoothing, **settings)
    assert calls == [16, 16]
    assert bool(torch.isfinite(found).all())
    with pytest.raises(ValueError, match="fn returned nan"):
        zh.finite_difference_hvp(square, vector(0.3, -0.2), vector(1.0, 2.0), smoothing)


def test_gradients_that_are_nearly_equal_are_not_rounded_before_their_difference() -> None:
    """They are near 1e6 here, where neighbours in float32 are 0.06 apart; their difference is 0.03."""
    x, v, smoothing = torch.zeros(2), torch.tensor([1.0, 0.0]), zh.Smoothing(sigma=0.05, samples=4000, seed=0)
    products = [
        zh.finite_difference_hvp(
            lambda z, k=slope: k * z[:, 0].double() + z.double().square().sum(1) / 2, x, v, smoothing
        )
        for slope in (0.0, 1e6)
    ]
    assert float(products[1][0]) == pytest.approx(1.0, abs=0.1)
    torch.testing.assert_close(products[1], products[0], rtol=1e-3, atol=1e-3)  # a slope has no curvature


def test_a_product_beyond_the_type_of_x_is_named() -> None:
    with pytest.raises(ValueError, match=r"the product with the Hessian is not finite in torch\.float32"):
        zh.finite_difference_hvp(
            lambda z: 1e30 * z.double().square().sum(1),
            torch.zeros(1),
            1e20 * torch.ones(1),
            zh.Smoothing(sigma=0.5, seed=0),
        )


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    """The step is below the distance of neighbouring numbers of bfloat16 at 100."""
    smoothing, v = zh.Smoothing(sigma=0.5, samples=256, seed=0), torch.tensor([1.0, 0.0])
    x = torch.tensor([100.0, 1.0])
    expected = zh.finite_difference_hvp(lambda z: z.square().sum(1), x, v, smoothing)
    found = zh.finite_difference_hvp(lambda z: z.square().sum(1), x.to(dtype), v.to(dtype), smoothing)
    assert found.dtype == dtype
    assert torch.equal(found, expected.to(dtype))
    assert abs(float(found[0]) - 2.0) < 0.1


@pytest.mark.parametrize("sigma", [1e-4, 3e-4])
def test_a_step_that_rounding_changes_is_an_error(sigma: float) -> None:
    """Neighbours of 1 000 are 6e-5 apart. Of the smaller step nothing would be left, of the other one a third more."""
    x = torch.tensor([1000.0, 1000.0])
    v, smoothing = torch.tensor([1.0, 0.5]), zh.Smoothing(sigma=sigma, samples=4, seed=0)
    with pytest.raises(ValueError, match=r"step is below the rounding of x in torch\.float32"):
        zh.finite_difference_hvp(lambda z: z.square().sum(1), x, v, smoothing)
    zh.finite_difference_hvp(lambda z: z.square().sum(1), x.double(), v, smoothing)
    zh.finite_difference_hvp(lambda z: z.square().sum(1), x, 0.0 * v, smoothing)


def test_errors() -> None:
    smoothing = zh.Smoothing(sigma=0.5, samples=4, seed=0)
    with pytest.raises(ValueError, match=r"shape \[3\] or of the shape of x, got torch.Size\(\[2\]\)"):
        zh.finite_difference_hvp(WAVE.f, torch.ones(3), torch.ones(2), smoothing)
    with pytest.raises(ValueError, match=r"step must be positive and finite, got 0\.0"):
        zh.finite_difference_hvp(WAVE.f, torch.ones(3), torch.ones(3), smoothing, step=0.0)
    with pytest.raises(TypeError, match="step must be a number, got True"):
        zh.finite_difference_hvp(WAVE.f, torch.ones(3), torch.ones(3), smoothing, step=True)
    with pytest.raises(TypeError, match=r"x must be a torch tensor \[\*batch, n\], got list"):
        zh.finite_difference_hvp(WAVE.f, [1.0, 1.0], torch.ones(2), smoothing)
    with pytest.raises(TypeError, match="smoothing must be a Smoothing, got float"):
        zh.finite_difference_hvp(WAVE.f, torch.ones(3), torch.ones(3), 0.5)
