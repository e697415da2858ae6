"""Losses that are larger than models can take, and numerical failures: whose they are, and that a search goes on."""

import math
import sys

import pytest
import torch
from searches import bowl, zeros

import torch_zerohess as zh
from torch_zerohess.linalg.subproblem import ball_step
from torch_zerohess.search.region import method
from truths import normal

LARGEST = sys.float_info.max


def failing() -> torch.Tensor:
    """Fail in the library as a model with numbers that are not finite does."""
    return ball_step(torch.zeros(3), torch.full((3, 3), math.nan), 1.0)


@pytest.mark.parametrize("seed", [0, 1])
def test_a_penalty_may_be_the_largest_number(seed):
    def penalised(z):
        return torch.where(z[:, 0] > 0.5, LARGEST, (z - 0.3).square().sum(1))

    fit = zh.minimize(penalised, [0.2, -0.5, -0.5, -0.5, -0.5], sigma=0.5, seed=seed, max_evaluations=150)
    assert fit.success
    assert fit.value < 1e-15
    assert float(fit.values.max()) == LARGEST


@pytest.mark.parametrize(("n", "bounds"), [(2, (-2.0, 2.0)), (3, None), (5, None)])
def test_an_output_may_have_the_largest_number(n, bounds):
    """The loss of such an output is finite."""
    goal = torch.full((n,), 0.3, dtype=torch.float64)

    def outputs(z):
        return torch.where(z[:, :1] > 0.45, LARGEST, z)

    loss = lambda y: (y - goal).tanh().square().mean()  # noqa: E731
    fit = zh.minimize(outputs, zeros(n), sigma=0.5, bounds=bounds, loss=loss, seed=0, max_evaluations=100)
    assert fit.value < 1e-10


def test_a_start_that_models_cannot_take_is_refused():
    with pytest.raises(ValueError, match=r"the loss at the start x0 is -1.7\S*, below -1e\+305: scale the loss"):
        zh.minimize(lambda z: z[:, 0] - LARGEST, zeros(2), sigma=1.0)
    for bounds in (None, (-2.0, 2.0)):
        with pytest.raises(ValueError, match=r"the loss at the start x0 is 5.3\S*, above 1e\+305: scale the loss, or"):
            zh.minimize(lambda z: 4.5e307 * (1.0 + (z - 0.3).square().sum(1)), zeros(2), sigma=0.5, bounds=bounds)
    with pytest.raises(ValueError, match=r"3 of 3 numbers of the output .* or beyond 1e\+100"):
        zh.minimize(lambda z: z[:, :1].expand(-1, 3) + LARGEST, zeros(2), sigma=1.0, loss=lambda y: y.tanh().sum())


@pytest.mark.parametrize("noise", [1e-9, 1e60])
@pytest.mark.parametrize(
    ("bounds", "output", "engine"),
    [(None, False, "auto"), ((-2.0, 2.0), False, "auto"), ((-2.0, 2.0), True, "auto"), (None, True, "local")],
)
def test_noise_may_be_far_larger_than_the_losses(bounds, output, engine, noise):
    def small(y):
        return 1e-200 * y.square().sum(-1)

    more = {"bounds": bounds, "engine": engine, "loss": small if output else None}
    fn = (lambda z: z) if output else small
    fit = zh.minimize(fn, 1.0 + zeros(2), sigma=0.5, noise=noise, seed=0, max_evaluations=40, **more)
    assert 0.0 <= fit.value < 1e-199
    assert noise / 4 < fit.value_error < noise
    assert fit.standard_errors is None or bool(torch.isfinite(fit.standard_errors["gradient"]).all())


@pytest.mark.parametrize("scale", [1e-240, 1e240])
def test_noise_of_the_largest_and_of_the_smallest_losses_is_measured(scale):
    """Squares of these numbers are no numbers."""
    found = []
    for size in (1.0, scale):
        generator = torch.Generator().manual_seed(0)

        def fn(z, size=size, generator=generator):
            return size * (z.square().sum(1) + 0.1 * torch.randn(len(z), generator=generator).double())

        found.append(zh.minimize(fn, 1.0 + zeros(2), sigma=0.5, seed=0, max_evaluations=60))
    one, other = found
    assert other.noise == pytest.approx(scale * one.noise)
    assert other.value_error == pytest.approx(scale * one.value_error, rel=0.5)


def test_a_search_goes_on_after_a_numerical_failure(monkeypatch):
    """Twice. After a failure the search counts the new values as lost and tries other steps, and these do not fail."""
    right, calls = method.region_step, []

    def step(*args):
        calls.append(args)
        return failing() if len(calls) in (2, 9) else right(*args)

    monkeypatch.setattr(method, "region_step", step)
    fit = zh.minimize(bowl, zeros(2), sigma=2.0, seed=0, restarts=0)
    assert len(calls) > 9
    assert fit.success
    assert fit.value < 1e-8


@pytest.mark.parametrize("loss", [None, torch.sum])
def test_a_numerical_failure_of_the_search_is_not_blamed_on_fn(loss, monkeypatch):
    """Here every step fails. With a loss, too, the models fail, and the loss is well."""
    monkeypatch.setattr(method, "region_step", lambda *args: failing())
    with pytest.raises(torch.linalg.LinAlgError) as caught:
        zh.minimize(lambda z: bowl(z) if loss is None else z.square(), zeros(2) + 1.0, sigma=2.0, seed=0, loss=loss)
    assert caught.value.minimum.message.startswith("the search raised _LinAlgError")


def test_a_numerical_failure_of_fn_is_its_own():
    def fails(z):
        return bowl(z) if not bool(z[0].any()) else torch.linalg.cholesky(-torch.eye(len(z)))

    with pytest.raises(torch.linalg.LinAlgError) as caught:
        zh.minimize(fails, zeros(2), sigma=2.0, seed=0)
    assert caught.value.minimum.message.startswith("fn raised _LinAlgError")


def test_a_numerical_failure_of_the_loss_passes():
    """A loss may fail where a model expands it, not only at an output; here it does so once."""
    expanded = []

    def loss(y):
        if y.requires_grad:
            expanded.append(y)
            if len(expanded) == 3:
                torch.linalg.cholesky(-torch.eye(2))
        return (y.sin() + 0.5).square().sum()

    with pytest.raises(torch.linalg.LinAlgError) as caught:
        zh.minimize(lambda z: z + 1.0, zeros(3), sigma=1.0, seed=0, loss=loss)
    assert caught.value.minimum.message.startswith("fn or loss raised _LinAlgError")


@pytest.mark.parametrize("engine", ["auto", "descent"])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_derivatives_across_a_bound_are_true_within_their_errors(engine, seed):
    """Outputs A z with the loss |A z - b|^2: the gradient is 2 A'(A z - b), the Hessian 2 A'A."""
    A = torch.eye(3, dtype=torch.float64) + 0.3 * normal(3, 3)
    b = A @ torch.tensor([2.0, 0.5, -0.3], dtype=torch.float64)
    fit = zh.minimize(
        lambda z: z @ A.mT,
        [0.2, 0.0, 0.0],
        loss=lambda output: (output - b).square().sum(),
        sigma=0.5,
        bounds=([-1.0] * 3, [1.0] * 3),
        engine=engine,
        seed=seed,
        max_evaluations=100,
    )
    gradient, hessian = 2 * A.mT @ (A @ fit.x.double() - b), 2 * A.mT @ A
    errors = fit.standard_errors
    assert float(fit.x[0]) == 1.0
    assert bool(((fit.gradient - gradient).abs() <= 3 * errors["gradient"] + 1e-3).all())
    assert bool(((fit.hessian - hessian).diagonal().abs() <= 3 * errors["hessian_diagonal"] + 0.02).all())


@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_rounding_of_the_loss_is_in_the_errors_of_the_hessian(seed):
    """Next to a bound the evaluations are so near each other that the curvature is of the size of rounding."""
    fit = zh.minimize(
        lambda z: (z[:, 0] - 2).square() + (z[:, 1] - z[:, 0]).square(),
        [0.0, 0.0],
        sigma=0.5,
        bounds=([-1, -1], [1, 1]),
        seed=seed,
        max_evaluations=100,
    )
    missed = fit.hessian.diagonal() - torch.tensor([4.0, 2.0])
    assert bool((missed.abs() <= 3 * fit.standard_errors["hessian_diagonal"]).all())
    assert float(missed.abs().max()) < 0.1
