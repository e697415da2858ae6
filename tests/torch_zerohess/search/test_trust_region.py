"""The door: which search it chooses, and that it is that search."""

import re

import pytest
import torch
from searches import points_of, rays, rays_loss, rosenbrock, zeros

import torch_zerohess as zh
from torch_zerohess.optim import Descent, GaussianProcessSearch, TrustRegion
from truths import vector

INFINITE = float("inf")


@pytest.mark.parametrize("loss", [None, torch.sum])
@pytest.mark.parametrize(
    ("n", "bounds", "engine", "reason"),
    [
        (1, (-1.0, 1.0), "gaussian_process", "a finite box of 1 parameter$"),
        (4, (-1.0, 1.0), "gaussian_process", "a finite box of 4 parameters$"),
        (5, (-1.0, 1.0), "descent", "a box of up to 4 parameters, and there are 5$"),
        (1, None, "descent", "not every parameter has finite bounds"),
        (2, (-1.0, vector(1.0, INFINITE)), "descent", "not every parameter has finite bounds"),
        (2, (-1.0, vector(1.0, 1e200)), "descent", "not every parameter has finite bounds"),
        (2, (-1.0, vector(1.0, 1e90)), "gaussian_process", "a finite box"),
    ],
)
def test_it_chooses_by_the_number_of_parameters_and_the_bounds(n, bounds, engine, reason, loss):
    search = TrustRegion(zeros(n), sigma=1.0, bounds=bounds, loss=loss)
    assert search.engine == engine
    assert re.search(reason, search.reason)


@pytest.mark.parametrize("loss", [None, lambda output: output.square().sum()])
def test_squares_of_distances_in_a_very_wide_box_do_not_overflow(loss):
    found = zh.minimize(
        lambda z: z - 3.0 if loss else (z - 3.0).square().sum(1), [0.0], sigma=1.0, loss=loss, bounds=(-1e200, 1e200)
    )
    assert found.success
    assert float(found.x) == pytest.approx(3.0, abs=1e-6)
    with pytest.raises(ValueError, match=r"must be finite for a Gaussian process.* got bounds 2e\+200 sigma apart for"):
        TrustRegion(zeros(1), sigma=1.0, bounds=(-1e200, 1e200), loss=loss, engine="gaussian_process")


@pytest.mark.parametrize(("n", "with_loss"), [(2, True), (5, False), (5, True)])
@pytest.mark.parametrize(("engine", "kind"), [("descent", Descent), ("gaussian_process", GaussianProcessSearch)])
def test_the_engine_may_be_chosen_and_is_that_class(engine, kind, n, with_loss):
    """The same points to the last bit, also beyond the number of parameters up to which a process is the choice."""
    settings = {"sigma": 1.0, "bounds": (-3.0, 4.0), "loss": rays_loss(n) if with_loss else None, "seed": 4}
    f = rays if with_loss else rosenbrock
    door, search = TrustRegion(zeros(n), engine=engine, **settings), kind(zeros(n), **settings)
    assert door.engine == search.engine == engine
    assert door.reason == "the caller chose it"
    assert torch.equal(points_of(door, f, 40), points_of(search, f, 40))
    assert door.model_at_best()[1] == search.model_at_best()[1]
    other = TrustRegion(zeros(n), engine=engine, **settings)
    other.load_state_dict(search.state_dict())
    for name in ("value", "sigma", "evaluations", "iterations", "rounds", "done", "message"):
        assert getattr(other, name) == getattr(door, name) == getattr(search, name)
    for name in ("x", "center", "unit"):
        assert torch.equal(getattr(other, name), getattr(search, name))


def test_a_model_of_the_search_that_evidence_has_chosen_is_around_the_given_point():
    """Of |A z - b|^2 the gradient is 2 A^T (A x - b)."""
    generator = torch.Generator().manual_seed(0)
    A, b = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in ((60, 20), (60,)))
    search = TrustRegion(zeros(20), sigma=1.0, loss=lambda y: (y - b).square().sum(), seed=0)
    points_of(search, lambda z: z @ A.mT, 40)
    assert search.engine == "descent"
    for step in 0.2 * torch.randn(4, 20, generator=generator, dtype=torch.float64):
        x = search.x + step
        model, sigma = search.model_at_best(x)
        truth = 2 * A.mT @ (A @ x - b)
        assert float((model.full_gradient() / sigma - truth).norm()) < 0.05 * float(truth.norm())


@pytest.mark.parametrize("bounds", [None, (-1.0, vector(1.0, INFINITE)), (vector(-1.0, -INFINITE), 1.0)])
def test_a_process_needs_a_finite_box(bounds):
    for make in (GaussianProcessSearch, lambda x0, **settings: TrustRegion(x0, engine="gaussian_process", **settings)):
        with pytest.raises(
            ValueError, match=rf"bounds must be finite .* for parameter {int(bounds is not None)}; Descent"
        ):
            make(zeros(2), sigma=1.0, bounds=bounds)


@pytest.mark.parametrize("engine", ["newton", None, "GaussianProcess"])
def test_an_engine_that_there_is_not(engine):
    with pytest.raises(
        ValueError, match=f"engine must be one of .*'auto', 'gaussian_process', 'descent'.*, got {engine!r}"
    ):
        TrustRegion(zeros(2), sigma=1.0, engine=engine)
