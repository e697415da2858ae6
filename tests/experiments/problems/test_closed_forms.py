"""The closed forms against quadrature: the only place where a truth is itself under test."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import integrate, stats

from truths import Bump, ClosedForm, Exponential, PlaneWave, Step, spread, truths, vector

SMOOTH = ["quadratic", "wave", "exponential", "bump", "image"]
NODES = 60


def gauss_hermite(n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Nodes u [NODES^n, n] and weights of the standard normal density."""
    u, w = np.polynomial.hermite_e.hermegauss(NODES)
    grid = torch.cartesian_prod(*[torch.tensor(u)] * n).reshape(-1, n)
    weight = torch.cartesian_prod(*[torch.tensor(w / math.sqrt(2 * math.pi))] * n).reshape(-1, n).prod(1)
    return grid, weight


@pytest.mark.parametrize("n", [1, 2])
@pytest.mark.parametrize("name", SMOOTH)
def test_smooth_functions_against_gauss_hermite(name: str, n: int) -> None:
    check(truths(n)[name], n)


@pytest.mark.parametrize(
    "form",
    [
        PlaneWave(vector(1.0, -0.7), 0.3, 0.9, vector(0.2, -0.4)),
        Exponential(vector(0.3, -0.5), vector(0.7, 0.1)),
        Bump(vector(0.8, 1.5), vector(-0.3, 0.2)),
    ],
    ids=lambda form: type(form).__name__,
)
def test_an_origin_moves_the_function(form: ClosedForm) -> None:
    check(form, 2)
    still = replace(form, origin=0.0)
    at = spread(6, -1.0, 1.0).view(3, 2)
    torch.testing.assert_close(form(at), still(at - form.origin))


def check(truth: ClosedForm, n: int) -> None:
    """Compare with Gauss-Hermite quadrature of f and of Stein's identities."""
    x, sigma = spread(n, -0.5, 0.8), spread(n, 0.2, 0.9)
    u, w = gauss_hermite(n)
    f = truth.f(x + sigma * u)
    kernel = u[:, :, None] * u[:, None, :] - torch.eye(n, dtype=torch.float64)
    value = torch.einsum("k,k...->...", w, f)
    gradient = torch.einsum("k,k...,ki->...i", w, f, u) / sigma
    hessian = torch.einsum("k,k...,kij->...ij", w, f, kernel) / (sigma[:, None] * sigma)
    torch.testing.assert_close(truth.value(x, sigma), value, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(truth.gradient(x, sigma), gradient, rtol=1e-11, atol=1e-11)
    torch.testing.assert_close(truth.hessian(x, sigma), hessian, rtol=1e-10, atol=1e-10)
    if value.ndim == 0:
        torch.testing.assert_close(truth.hvp(x, sigma, x), hessian @ x, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("x", [-1.0, 0.1, 0.4])
def test_step_in_one_dimension_against_adaptive_quadrature(x: float) -> None:
    step, sigma = Step(vector(-1.5), 0.3), 0.4
    jump = (step.c / -1.5 - x) / sigma

    def integral(kernel) -> float:
        def integrand(u: float) -> float:
            return float(step.f(vector(x + sigma * u)[None])) * kernel(u) * stats.norm.pdf(u)

        return integrate.quad(integrand, -12.0, 12.0, points=[jump], epsabs=1e-13, limit=200)[0]

    at, s = vector(x), vector(sigma)
    assert float(step.value(at, s)) == pytest.approx(integral(lambda u: 1.0), abs=1e-10)
    assert float(step.gradient(at, s)) == pytest.approx(integral(lambda u: u) / sigma, abs=1e-10)
    assert float(step.hessian(at, s)) == pytest.approx(integral(lambda u: u * u - 1.0) / sigma**2, abs=1e-10)


def test_step_in_two_dimensions_against_one_exact_and_one_quadrature_integral() -> None:
    step, x, sigma = Step(vector(0.8, -1.1), 0.2), vector(0.3, -0.4), vector(0.5, 0.7)
    u, w = gauss_hermite(1)
    # Given u_0, the half-space is the tail of a normal in u_1.
    edge = (step.c - step.w[0] * (x[0] + sigma[0] * u[:, 0]) - step.w[1] * x[1]) / (step.w[1] * sigma[1])
    inner = torch.tensor(stats.norm.cdf(edge.numpy()))  # w[1] < 0: below the edge
    assert float(step.value(x, sigma)) == pytest.approx(float((w * inner).sum()), abs=1e-12)


def test_image_is_its_parts_in_order() -> None:
    image, z = truths(3)["image"], spread(12, -1.0, 1.0).view(4, 3)
    parts = [part.f(z) for part in image.parts]
    assert image.f(z).shape == (4, 2, 2)
    assert torch.equal(image.f(z), torch.stack([torch.stack(parts[:2], 1), torch.stack(parts[2:], 1)], 1))


def test_f_is_rounded_to_the_type_of_its_points() -> None:
    wave, z = PlaneWave(vector(0.9, -1.3)), spread(8, -1.0, 1.0).view(4, 2)
    assert wave(z.float()).dtype == torch.float64
    assert torch.equal(wave.f(z.float()), wave(z.float()).float())
