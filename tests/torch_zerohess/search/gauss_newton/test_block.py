"""Block Gauss-Newton: the Jacobian, its steps, and problems whose solution is known in closed form."""

import math
from itertools import pairwise

import pytest
import torch
from scipy.optimize import lsq_linear
from searches import Linear, run, square, zeros

import torch_zerohess as zh
from torch_zerohess.search.gauss_newton.block import broyden_update
from torch_zerohess.search.gauss_newton.by_samples import STEP_LENGTHS
from truths import normal


def test_a_jacobian_is_known_after_a_basis_of_samples():
    a, basis = normal(8, 20), torch.linalg.qr(normal(8, 8, seed=1))[0]
    jacobian = torch.zeros(8, 20)
    for steps in (0.3 * basis).split(3):
        jacobian = broyden_update(jacobian, steps, steps @ a)
    torch.testing.assert_close(jacobian, a.float(), atol=1e-4, rtol=0)


def test_along_the_samples_it_is_renewed_and_across_them_it_stays():
    before, a, steps = normal(8, 20).float(), normal(8, 20, seed=1), 0.1 * normal(3, 8, seed=2)
    after = broyden_update(before, steps, steps @ a).double()
    torch.testing.assert_close(steps @ after, steps @ a, atol=1e-4, rtol=0)
    across = torch.linalg.qr(steps.mT, mode="complete")[0][:, 3:].mT
    torch.testing.assert_close(across @ after, across @ before.double(), atol=1e-4, rtol=0)
    # Broyden's formula for a single step, and nothing from a step of no length.
    one, change = steps[:1], normal(1, 20, seed=3)
    broyden = before.double() + one.mT @ (change - one @ before.double()) / one.square().sum()
    torch.testing.assert_close(broyden_update(before, one, change).double(), broyden, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(broyden_update(before, 0.0 * one, 0.0 * change), before)


def test_a_step_of_no_length_tells_nothing():
    """In noise the output changes along it, too: where the Jacobian is zero, all steps are such steps."""
    a, before = normal(5, 3), normal(5, 3).float()
    steps = torch.cat([torch.zeros(1, 5).double(), torch.eye(5).double()[:2]])
    changes = steps @ a + 1e-3
    assert torch.equal(broyden_update(before, steps[:1], changes[:1]), before)
    assert torch.equal(broyden_update(before, steps, changes), broyden_update(before, steps[1:], changes[1:]))


def test_samples_that_bounds_have_made_dependent():
    """Twelve steps in a space of three dimensions."""
    a, before = normal(4, 6), torch.zeros(4, 6)
    steps = normal(12, 3, seed=1) @ normal(3, 4, seed=2)
    after = broyden_update(before, steps, steps @ a).double()
    torch.testing.assert_close(steps @ after, steps @ a, atol=1e-3, rtol=0)


@pytest.mark.parametrize(("n", "m"), [(40, 100), (40, 25)])
def test_linear_least_squares_take_one_jacobian_and_one_step(n, m):
    """Also where fewer outputs than parameters leave the solution open, and at any distance within the longest step."""
    a, b = normal(n, m) / math.sqrt(n), normal(m, seed=1)
    lowest = float((torch.linalg.lstsq(a.mT, b[:, None]).solution[:, 0] @ a - b).square().mean())
    search = zh.optim.BlockGaussNewton(torch.zeros(n).double(), sigma=8.0, loss=square(b), seed=0)
    assert search.ask().shape == (1 + n, n)
    run(search, lambda x: x @ a, 1 + n + len(STEP_LENGTHS))
    assert search.evaluations == 1 + n + len(STEP_LENGTHS)
    assert search.iterations == 1
    assert search.value - lowest < 1e-5 * float(b.square().mean())


def test_the_curvature_of_any_loss_is_used():
    """A convex loss whose Hessian is no multiple of the identity: with it one step suffices, without it none does."""
    n, m = 20, 30
    a, b, w = normal(n, m) / math.sqrt(n), normal(m, seed=1), torch.logspace(-3, 3, m, dtype=torch.float64)
    best = torch.linalg.lstsq(w.sqrt()[:, None] * a.mT, (w.sqrt() * b)[:, None]).solution[:, 0]

    def loss(y):
        return (w * (y - b).square()).sum() / 2

    search = zh.optim.BlockGaussNewton(torch.zeros(n).double(), sigma=10.0, loss=loss, seed=0)
    run(search, lambda x: x @ a, 1 + n + len(STEP_LENGTHS))
    lowest, first = float(loss(best @ a)), float(loss(torch.zeros(m)))
    assert search.value - lowest < 1e-3 * (first - lowest)


def bent(n, m):
    """A black box [K, n] -> [K, m] that is far from linear, and a point."""
    a = normal(n, m) / math.sqrt(n)
    return (lambda x: torch.sin(x @ a) + 0.5 * x @ a), 0.7 * normal(n, seed=1)


def test_a_bent_black_box_takes_few_blocks():
    f, truth = bent(60, 120)
    search = zh.optim.BlockGaussNewton(torch.zeros(60).double(), sigma=1.0, loss=square(f(truth[None])[0]), seed=0)
    losses = []
    run(search, f, 61 + 12 * (15 + 6), values=losses)
    assert all(later <= earlier for earlier, later in pairwise(losses))
    assert search.value < 1e-4 * losses[0]
    torch.testing.assert_close(search.x, truth, atol=0.05, rtol=0)


def test_a_solution_that_is_far_is_reached_in_steps_of_growing_length():
    """A distance of 50 first radii: 1 + 2.5 + 2.5^2 + ... is there in five steps."""
    a = torch.linalg.qr(normal(30, 20))[0].mT
    search = zh.optim.BlockGaussNewton(torch.zeros(20).double(), sigma=0.1, loss=square(2.5 * a.sum(0)), seed=0)
    losses = []
    run(search, lambda x: x @ a, 21 + 6 * (5 + 6), values=losses)
    assert search.iterations <= 6
    assert search.value < 1e-6 * losses[0]


def test_the_decrease_to_a_minimum_within_reach_is_promised_and_no_other():
    a = normal(5, 12) / 2

    def outputs(x):
        return x @ a + 0.02 * (x @ a).square()

    goal = outputs(torch.full((1, 5), 3.0, dtype=torch.float64))[0]  # farther than the longest first step
    search, reached = zh.optim.BlockGaussNewton(torch.zeros(5).double(), sigma=1.0, loss=square(goal), seed=0), 0
    while search.value > 1e-6:
        search.tell(outputs(search.ask()))
        if search.promise < math.inf:
            assert search.promise == pytest.approx(search.value, rel=0.1)  # the least loss is 0
            assert float((search.x - 3.0).norm()) < STEP_LENGTHS[-1] * float(search.width.norm())
            reached += 1
        else:
            assert bool((search.width == math.inf).all())
    assert reached >= 3


def test_the_promise_at_kinks_is_the_decrease_of_the_loss_of_linear_outputs():
    """The outputs are linear, so the decrease is that of the black box."""
    fn = Linear(10, 0, "mean", side=100.0)
    search, promised = zh.optim.BlockGaussNewton(zeros(10), sigma=1.0, loss=fn.loss, seed=0), 0
    while search.evaluations < 30:
        promise, before = search.promise, search.value
        search.tell(fn(search.ask()))
        if promise < math.inf:
            assert promise == pytest.approx(before - search.value, rel=1e-3)
            promised += 1
    assert promised == 2


def test_where_a_long_step_overshoots_a_short_one_of_the_same_batch_is_taken():
    """Newton's step for atan(5 x) from 1 ends at -6.1; all steps from 2 upward raise the loss."""
    search = zh.optim.BlockGaussNewton(
        torch.ones(4).double(), sigma=8.0, loss=lambda y: y.square().mean(), share=1e-3, seed=0
    )
    losses = []
    run(search, lambda x: torch.atan(5 * x), 5 + 6, values=losses)
    assert search.iterations == 1
    assert search.value < 0.7 * losses[0]


def test_a_block_costs_a_quarter_of_the_parameters_and_steps():
    f, truth = bent(60, 120)
    search = zh.optim.BlockGaussNewton(torch.zeros(60).double(), sigma=1.0, loss=square(f(truth[None])[0]), seed=0)
    sizes = []
    for _ in range(10):
        points = search.ask()
        sizes.append(len(points))
        search.tell(f(points))
    assert sizes == [61, 6, 15, 6, 15, 6, 15, 6, 15, 6]


def test_directions_of_one_basis_are_orthogonal_and_as_far_as_sigma_says():
    search = zh.optim.BlockGaussNewton(
        torch.zeros(12).double(), sigma=2.0, loss=lambda y: y.square().mean(), share=0.2, block=0.5, seed=0
    )
    points = search.ask()[1:]
    length = 2.0 * 0.5 * 0.2 * math.sqrt(12)
    torch.testing.assert_close(points @ points.mT, length**2 * torch.eye(12).double(), atol=1e-5, rtol=0)
    assert search.sigma == pytest.approx(0.1)


def test_it_stays_within_the_bounds_and_solves_there():
    """The solution has half of its parameters at their bounds."""
    n, m = 30, 60
    a = torch.linalg.qr(normal(m, n))[0].mT
    wanted = torch.linspace(-1, 1, n, dtype=torch.float64) * 1.5
    search = zh.optim.BlockGaussNewton(
        torch.full((n,), 0.74).double(), sigma=0.5, bounds=(-0.75, 0.75), loss=square(wanted @ a), seed=0
    )

    def f(x):
        assert float(x.abs().max()) <= 0.75
        return x @ a

    run(search, f, 400)
    torch.testing.assert_close(search.x, wanted.clamp(-0.75, 0.75), atol=0.02, rtol=0)


@pytest.mark.parametrize("seed", range(3))
def test_least_squares_on_the_sides_of_a_box_are_solved(seed):
    """Steps along parameters that a bound holds would be no descent after they are cut off."""
    fn = Linear(20, seed, "mean")
    search = zh.optim.BlockGaussNewton(
        zeros(20), sigma=1.0, bounds=(-1, 1), loss=square(fn.target), seed=seed, restarts=0
    )
    run(search, fn, 300)
    x = torch.from_numpy(lsq_linear(fn.a.numpy(), fn.target.numpy(), (-1, 1), tol=1e-14).x)
    assert search.solved
    torch.testing.assert_close(search.x, x, atol=1e-6, rtol=0)


@pytest.mark.parametrize("seed", range(2))
def test_a_mean_of_magnitudes_is_minimised_as_a_whole(seed):
    """Its quadratic is a plane: steps along it end at the first kinks, a tenth of the loss above the minimum."""
    fn = Linear(10, seed, "mean", side=100.0)
    search = run(zh.optim.BlockGaussNewton(zeros(10), sigma=1.0, loss=fn.loss, seed=seed, restarts=0), fn, 300)
    assert search.solved
    assert fn.excess(search.value) < 1e-3


def test_on_steps_it_has_not_arrived():
    """Samples within a step change no output, so that nothing is known of the loss."""
    search = zh.optim.BlockGaussNewton(zeros(10), sigma=1.0, loss=square(3.0), seed=0, restarts=0)
    while not search.done:
        search.tell(search.ask().round())
    assert not search.solved


def test_a_start_in_a_corner_is_sampled_away_from_it():
    """Both signs of a direction leave the box in some parameters; together the samples still determine the slopes."""
    n = 6
    a = normal(n, 10)
    search = zh.optim.BlockGaussNewton(
        torch.ones(n).double(), sigma=0.2, bounds=(-1.0, 1.0), loss=square(torch.zeros(10)), seed=0
    )
    points = search.ask()
    assert float((points[1:] - 1.0).norm(dim=1).min()) > 0.3 * 0.2 * 0.05 * math.sqrt(n)
    run(search, lambda x: x @ a, 200)
    assert search.value < 1e-4 * float((torch.ones(n).double() @ a).square().mean())


def test_where_no_step_lowers_the_loss_the_radius_shrinks_until_it_arrives():
    search = zh.optim.BlockGaussNewton(
        torch.zeros(4).double(), sigma=1.0, loss=lambda y: y.square().mean(), restarts=1, tolerance=0.05, seed=0
    )
    sigmas, rounds = [], []
    while not search.done:
        search.tell(search.ask() + torch.tensor([0.0, 1.0, 2.0, 3.0]) * 0.0)  # zero at the start: the minimum
        sigmas.append(search.sigma)
        rounds.append(search.rounds)
    assert search.rounds == 2
    assert search.value == 0.0
    assert "below 0.05 of sigma, in round 2" in search.message
    # 0.5 x 0.4^3 < 0.05: three refusals, and again from the first radius with a whole basis.
    once = [0.05, 0.02, 0.02, 0.008, 0.008, 0.05]
    assert sigmas[:6] == pytest.approx(once)
    assert search.iterations == 6
    with pytest.raises(RuntimeError, match="the search is done"):
        search.ask()


def test_values_that_are_not_finite_are_passed_over():
    f, truth = bent(30, 60)

    def hole(x):
        y = f(x)
        y[::7] = math.nan
        return torch.where(x[:, :1] > 1.0, math.inf, y)

    start = torch.zeros(30).double()
    search = zh.optim.BlockGaussNewton(start, sigma=1.0, loss=square(f(truth[None])[0]), seed=0)
    search.tell(f(search.ask()))
    run(search, hole, 400)
    assert search.value < 1e-2 * float(f(truth[None]).square().mean())


def test_it_ends_where_nothing_is_finite():
    search = zh.optim.BlockGaussNewton(torch.zeros(5).double(), sigma=1.0, loss=torch.sum, seed=0)
    search.tell(search.ask())
    batches = 0
    while not search.done:
        search.tell(torch.full((len(search.ask()), 5), math.nan))
        batches += 1
    assert batches == 10
    assert "10 batches in a row had no finite value" in search.message


def test_a_limit_leaves_the_rest_for_later():
    f, truth = bent(20, 40)
    search = zh.optim.BlockGaussNewton(torch.zeros(20).double(), sigma=1.0, loss=square(f(truth[None])[0]), seed=0)
    first, asked = search.ask(), []
    for _ in range(7):
        asked.append(search.ask(limit=3))
        search.tell(f(asked[-1]))
    # The samples that a limit left out come in the next batches: the same 21 points in the end.
    torch.testing.assert_close(torch.cat(asked), first)
    assert search.evaluations == 21
    assert len(search.ask()) == len(STEP_LENGTHS)


def test_single_precision_and_units_per_parameter():
    """The same search in other units: parameters a hundred times larger with a sigma a hundred times larger."""
    f, truth = bent(20, 40)
    units = torch.logspace(-2, 2, 20)
    loss = square(f(truth[None])[0])
    search = zh.optim.BlockGaussNewton(torch.zeros(20), sigma=units, loss=loss, seed=0)
    assert search.ask().dtype == torch.float32
    run(search, lambda x: f((x / units).double()), 300)
    torch.testing.assert_close((search.x / units).double(), truth, atol=0.05, rtol=0)


@pytest.mark.parametrize("scale", [1e-25, 1e25])
def test_outputs_of_any_size(scale):
    f, truth = bent(20, 40)
    target = scale * f(truth[None])[0]
    search = zh.optim.BlockGaussNewton(torch.zeros(20).double(), sigma=1.0, loss=square(target), seed=0)
    run(search, lambda x: scale * f(x), 300)
    torch.testing.assert_close(search.x, truth, atol=0.05, rtol=0)


@pytest.mark.parametrize("scale", [1e-50, 1e50])
def test_outputs_that_its_type_cannot_hold_are_an_error(scale):
    """They would be zero or infinite, and so would the Jacobian."""
    search = zh.optim.BlockGaussNewton(zeros(4), sigma=1.0, loss=lambda y: (y / scale).square().mean(), seed=0)
    with pytest.raises(ValueError, match="BlockGaussNewton computes in float32, got outputs whose largest change"):
        search.tell(scale * search.ask())


@pytest.mark.parametrize("scale", [2.0**-80, 2.0**100])
@pytest.mark.parametrize("power", [2, 4])
def test_a_second_derivative_of_any_size(scale, power):
    """A loss in units of the outputs has second derivatives of 1 / scale^2, which float32 may not have."""
    f, truth = bent(20, 40)
    target, seen = f(truth[None])[0], []
    for size in (1.0, scale):

        def loss(y, size=size):
            return (y / size - target).pow(power).mean()

        search = zh.optim.BlockGaussNewton(torch.zeros(20).double(), sigma=1.0, loss=loss, seed=0)
        run(search, lambda x, size=size: size * f(x), 60)
        seen.append((search.x, search.value))
    torch.testing.assert_close(seen[1], seen[0], atol=1e-4, rtol=1e-3)


def test_the_model_at_the_best_point_is_gauss_newton():
    f, truth = bent(10, 30)
    target = f(truth[None])[0]
    search = zh.optim.BlockGaussNewton(torch.zeros(10).double(), sigma=0.5, loss=square(target), seed=0)
    assert search.model_at_best() is None
    run(search, f, 250)
    model, sigma = search.model_at_best()
    J = torch.func.jacrev(lambda x: f(x[None])[0])(search.x)
    torch.testing.assert_close(model.full_hessian() / (0.5 * sigma) ** 2, 2 / 30 * J.mT @ J, rtol=0.1, atol=0.01)


def test_what_cannot_be_searched_is_refused():
    start = torch.zeros(3).double()
    for name, value in (("radius", 0.0), ("share", 2.0), ("block", -0.1), ("radius", math.inf)):
        with pytest.raises(ValueError, match=f"{name} must be positive"):
            zh.optim.BlockGaussNewton(start, sigma=1.0, loss=torch.sum, **{name: value})
    with pytest.raises(ValueError, match="loss must be a function of one output, got None"):
        zh.optim.BlockGaussNewton(start, sigma=1.0, loss=None)


def test_the_rounding_of_outputs_is_no_kink():
    """A loss that is all rounding is not minimised as one with kinks, which takes hundreds of calls of it."""
    slopes, calls = 0.3 * normal(50, 30), []

    def f(x):
        return (x.double() @ slopes.mT).tanh()

    target = f(normal(30, seed=1).float() / 8.0)

    def loss(y):
        calls.append(1)
        return (y / 100.0 - target).square().mean()

    search = zh.optim.BlockGaussNewton(torch.zeros(30), sigma=0.1, seed=0, loss=loss, restarts=5)
    while not search.done:
        search.tell(100.0 * f(search.ask()))
    assert search.value < 1e-30
    assert len(calls) < 2 * search.evaluations
