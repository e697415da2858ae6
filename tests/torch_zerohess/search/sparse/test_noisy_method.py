"""Local Gauss-Newton in noise: it becomes more exact with every evaluation. The solutions are known in closed form."""

import math
from dataclasses import replace

import pytest
import torch
from searches import N, run, square
from searches import texels as image

import torch_zerohess as zh
from torch_zerohess.optim import LocalGaussNewton, TrustRegion
from torch_zerohess.search.protocol.state import Evaluated
from torch_zerohess.search.sparse.noisy_step import constants, step_in_noise
from truths import normal

SD = 0.05
TRUTH = 0.5 * normal(N)
TARGET = image(TRUTH[None])[0]
NOISE = 1e-3
"""Of the loss, at the start."""


def noisy(f=image, sd=SD, seed=0):
    """A black box whose numbers have errors with a standard deviation."""
    generator = torch.Generator().manual_seed(seed)

    def values(x):
        y = f(x)
        return y + sd * torch.randn(y.shape, generator=generator, dtype=y.dtype)

    return values


def search_for(loss=None, **settings):
    settings = {"sigma": 1.0, "loss": loss or square(TARGET), "noise": NOISE, "seed": 0} | settings
    return LocalGaussNewton(torch.zeros(N).double(), **settings)


def excess(x):
    """The loss without noise, over the variance of the noise."""
    return float((x - TRUTH).square().mean()) / SD**2


@pytest.mark.parametrize(
    ("engine", "loss", "most", "left"),
    [
        ("auto", "squares", 250, 0.04),
        ("auto", "squares", 400, 0.01),
        ("auto", "magnitudes", 250, 0.04),
        ("local", "magnitudes", 250, 0.04),
    ],
)
def test_the_error_falls_as_evaluations_are_added(engine, loss, most, left):
    """A single output would leave a loss of one variance. The mean of 400 leaves a four-hundredth of it."""
    losses = {"squares": square(TARGET), "magnitudes": lambda y: (y - TARGET).abs().mean()}
    settings = {"sigma": 1.0, "loss": losses[loss], "engine": engine, "seed": 0, "max_evaluations": most}
    fit = zh.minimize(noisy(), torch.zeros(N).double(), **settings)
    assert fit.engine == "local"
    assert excess(fit.x) < left
    assert not fit.success


def test_it_is_better_than_descent():
    settings = {"sigma": 1.0, "loss": square(TARGET), "seed": 0, "max_evaluations": 400}
    fits = [zh.minimize(noisy(), torch.zeros(N).double(), engine=one, **settings) for one in ("local", "descent")]
    assert excess(fits[0].x) < 0.1 * excess(fits[1].x)


def curved(x):
    return image(x + 0.25 * (3.0 * x).sin())


def test_curvature_brings_samples_nearer_until_noise_hides_the_slopes():
    search = run(search_for(square(curved(TRUTH[None])[0])), noisy(curved), 600)
    straight = run(search_for(), noisy(), 200)
    assert 0.03 < search.sigma < 0.5
    assert float(straight.sigma) == pytest.approx(1.0)
    assert float((curved(search.x[None])[0] - curved(TRUTH[None])[0]).square().mean()) < 0.3 * SD**2


def begun(search, f=image):
    """The progress after the first batch, without noise."""
    search.tell(f(search.ask()))
    return search._state.progress


def averaging(search, f=image):
    """The progress of a search that begins to average after the first batch, without noise."""
    known, method = begun(search, f), search._method
    return method.averaging.begun(replace(method._begin(known), sigma=0.5))


def told(points, shape):
    """Evaluations of points."""
    return Evaluated(points, torch.ones(len(points)).double(), image(points).flatten(1), shape)


def neighbours(x):
    """Pixels [K, 12, 12] that bend with a mean of four texels each."""
    mean = 0.4 * x + 0.3 * x.roll(1, 1) + 0.2 * x.roll(2, 1) + 0.1 * x.roll(3, 1)
    return image(mean + 0.3 * (2.0 * mean).sin())


def excess_of(f, x, sd):
    return float((f(x[None])[0] - f(TRUTH[None])[0]).square().mean()) / sd**2


def test_small_noise_of_a_curved_image_is_reached_and_then_averaged():
    """A wide regression alone would be at a million times the noise after 250 evaluations."""
    search, f = search_for(square(neighbours(TRUTH[None])[0]), noise=1e-7), noisy(neighbours, 1e-6)
    for most, least in ((250, 30.0), (1000, 0.5)):
        run(search, f, most)
        assert excess_of(neighbours, search.x, 1e-6) < least
        assert search.averages
        assert search.sigma < 0.03


def test_curvature_does_not_move_the_minimum():
    search = run(search_for(square(neighbours(TRUTH[None])[0])), noisy(neighbours), 700)
    assert excess_of(neighbours, search.x, SD) < 0.008


def test_a_loss_with_kinks_goes_on_to_fall():
    """What noise adds to a mean of magnitudes is no failure of the step."""
    search = run(search_for(lambda y: (y - TARGET).abs().mean()), noisy(), 600)
    assert search._state.progress.radius > 0.01


@pytest.mark.parametrize(("part", "averages"), [(0.9, True), (1.1, False)])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_averaging_begins_where_noise_hides_what_the_best_step_achieves(part, averages, sign):
    """Noise of the outputs of standard deviation s makes an error |gradient| s of the loss."""
    search = search_for()
    known = replace(begun(search), variance=1e-4)
    slope = 2.0 * (known.output - TARGET.flatten()) / N
    loss = known.loss + sign * part * 4.0 * 0.01 * float(slope.norm())
    steps = replace(told(known.center[None] + 0.01, known.shape), losses=torch.tensor([loss]).double())
    assert search._method.taken(known, steps).averaging == averages


def test_outputs_without_noise_are_not_averaged():
    """A step that changes nothing is shortened, as without noise."""
    search = search_for()
    known = replace(begun(search), variance=0.0)
    steps = replace(
        told(known.center[None] + 0.01, known.shape), losses=torch.tensor([known.loss], dtype=torch.float64)
    )
    after = search._method.taken(known, steps)
    assert (after.averaging, after.radius) == (False, pytest.approx(0.4 * known.radius))


@pytest.mark.parametrize(("agreed", "averages"), [(2, False), (3, True)])
def test_averaging_begins_after_three_rounds_that_agree(agreed, averages):
    search = search_for()
    known = begun(search).with_arrivals(agreed=agreed)
    after = search._method._hopping(known)
    assert (after.averaging, after.home is None) == (averages, averages)
    assert after.best.loss == known.best.loss


def test_evaluations_are_kept_once_while_the_search_hops():
    search = search_for()
    known = begun(search)
    after = search._method._hopping(known)
    assert len(after.home.points) == len(after.home.outputs) == 0
    failed = replace(after, points=known.points[:7], outputs=known.outputs[:7], variance=2.0, pairs=5, loss=math.inf)
    back = search._method._returned(failed)
    assert (len(back.points), len(back.outputs), back.variance, back.pairs) == (7, 7, 2.0, 5)


def test_it_begins_with_the_largest_sigma_without_curvature():
    """All 33 samples are at a sigma of 1."""
    straight, bent = averaging(search_for()), averaging(search_for(), lambda x: image(x + 0.3 * x.square()))
    assert straight.sigma == 1.0
    assert float((straight.center - TRUTH).square().mean()) < 1e-3
    search = search_for()
    known = replace(begun(search, lambda x: image(x + 0.3 * x.square())), variance=1e-4, pairs=1, sigma=0.5)
    assert search._method.averaging.begun(search._method._begin(known)).sigma == 0.5
    assert bent.averaging


def test_the_search_says_whether_it_has_averaged():
    """Then the decision of `minimize` trusts its x. The engine is chosen by the evaluations."""
    search, f = TrustRegion(torch.zeros(N).double(), sigma=1.0, loss=square(TARGET), noise=NOISE, seed=0), noisy()
    assert not search.averages
    search.tell(f(search.ask()))
    assert search.engine == "local"
    assert not search.averages
    assert run(search, f, 200).averages


@pytest.mark.parametrize(
    ("explained", "rest", "factor"),
    [(0.3, 1.06, 1 / 0.7), (0.3, 2.0, 1 / 0.7), (0.9, 1.0, 1 / 0.7), (0.9, 1.06, 1.0), (0.9, 2.0, 0.7)],
)
def test_samples_come_nearer_where_there_is_curvature_and_otherwise_go_apart(explained, rest, factor):
    """The changes that slopes predict have explained / (1 - explained) times the variance of what is left."""
    search = search_for()
    known = begun(search)
    jacobian = replace(known.jacobian, explained=explained)
    known = replace(known, jacobian=jacobian, sigma=0.1, variance=1.0, pairs=1)
    assert search._method.averaging.distance(known, rest) == pytest.approx(0.1 * factor)


@pytest.mark.parametrize(("explained", "least"), [(0.9, 5e-4), (0.4, 0.03)])
def test_samples_come_nearer_than_the_least_sigma_only_where_the_jacobian_predicts(explained, least):
    search = search_for()
    known = begun(search)
    jacobian = replace(known.jacobian, explained=explained)
    for sigma in (1.01 * least, 0.9 * least):
        known = replace(known, jacobian=jacobian, sigma=sigma, variance=1e-9, pairs=1)
        assert search._method.averaging.distance(known, 1.0) == pytest.approx(min(sigma, least))


def test_a_batch_is_the_center_twice_and_samples_whose_number_grows():
    search = search_for()
    f = noisy()
    counts = []
    while search.evaluations < 600:
        points = search.ask()
        if search.averages:
            assert torch.equal(points[0], search.center)
            assert torch.equal(points[1], search.center)
            counts.append(len(points))
        search.tell(f(points))
    assert counts[:3] == [34, 34, 34]
    assert counts[-1] > 60


def test_before_it_averages_samples_come_with_the_center_once():
    search, f = search_for(), noisy()
    while search._state.progress.phase == "trial" or not search.evaluations:
        search.tell(f(search.ask()))
    assert len(search.ask()) == 33
    assert torch.equal(search.ask()[0], search.center)
    assert (search._state.progress.variance, search._state.progress.pairs) == (0.0, 0)
    search.tell(f(search.ask()))
    assert search._state.progress.variance == pytest.approx(SD**2, rel=0.3)


def test_two_outputs_at_the_center_tell_the_noise():
    search = run(search_for(), noisy(), 300)
    assert search._state.progress.variance == pytest.approx(SD**2, rel=0.2)


def test_the_noise_is_a_mean_over_all_pairs_mostly_the_latest_ones():
    known = begun(search_for())
    for k in range(40):
        known = known.telling_noise(torch.zeros(2), torch.full((2,), math.sqrt(2.0 * k)))
        assert k > 15 or known.variance == pytest.approx(0.5 * k)
    assert 20.0 < known.variance < 39.0


def test_the_value_is_the_loss_of_the_output_that_the_regression_tells():
    search = run(search_for(), noisy(), 400)
    assert search.value < 0.1 * SD**2


def test_the_number_of_evaluations_that_are_kept_is_limited(monkeypatch):
    monkeypatch.setattr("torch_zerohess.search.sparse.noisy_method._KEPT", 100)
    known = run(search_for(), noisy(), 240)._state.progress
    assert (len(known.points), len(known.outputs)) == (100, 100)
    monkeypatch.setattr("torch_zerohess.search.sparse.noisy_method._HELD", 80 * 2 * N)
    assert len(run(search_for(), noisy(), 240)._state.progress.points) == 80


def test_by_itself_it_keeps_a_thousand_evaluations():
    search = search_for()
    known = begun(search)
    points = known.center + 0.1 * normal(1500, N)
    assert len(search._method._keeping(known, told(points, known.shape)).points) == 1024
    large = replace(known, points=known.points[:0], outputs=known.outputs[:0])
    wide = replace(told(points[:100], known.shape), outputs=torch.zeros(100, 2**19 - N).double())
    kept = search._method._keeping(large, wide)
    assert len(kept.points) == len(kept.outputs) == 64
    assert torch.equal(kept.points, points[:64])  # the lowest ones where another search hands over its evaluations


def test_far_evaluations_are_left_out():
    """The regression is of the 33 samples, although 20 other points are kept."""
    search = search_for()
    known = averaging(search)
    points = torch.cat([known.points, known.center + 3.0 * normal(20, N)])
    outputs = known.outputs + SD * normal(*known.outputs.shape)  # without noise rounding may look like curvature
    far = replace(known, points=points, outputs=torch.cat([outputs, normal(20, N)]))
    assert search._method.averaging.regressed(far, 0)[2] == 33.0


def test_a_step_that_raises_the_loss_is_undone():
    """The next samples are nearer, and the next step is shorter."""
    search = search_for()
    known = averaging(search)
    higher = replace(known, center=known.before.point + 2.0, sigma=1.0, variance=1e-6, pairs=15)
    points = torch.cat([higher.center.expand(2, -1), higher.center + normal(60, N)])
    none = replace(higher, points=higher.points[:0], outputs=higher.outputs[:0])
    after = search._method.sampled(none, told(points, known.shape))
    assert torch.equal(after.center, known.before.point)
    assert torch.equal(after.best.point, known.before.point)
    assert after.before is None
    assert after.radius == pytest.approx(0.5 * known.radius)
    assert after.sigma == pytest.approx(0.7)
    torch.testing.assert_close(after.output, image(after.center[None]).flatten(), atol=0.1, rtol=0.0)


def test_a_step_to_where_the_black_box_fails_is_undone():
    search = search_for()
    known = averaging(search)
    points = torch.cat([known.center.expand(2, -1), known.center + normal(60, N)])
    failed = told(points, known.shape)
    failed.losses[:2] = math.nan
    assert torch.equal(search._method.sampled(known, failed).center, known.before.point)
    failed.losses[1] = 1.0
    assert not torch.equal(search._method.sampled(known, failed).center, known.before.point)


def test_a_minimum_beside_a_wall_of_failures():
    def walled(x):
        return torch.where((x[:, :3].amax(1) > 1.2)[:, None, None], math.nan, noise(x))

    noise = noisy()
    target = TRUTH.clone()
    target[:3] = 1.5
    search = run(search_for(square(image(target[None])[0])), walled, 800)
    assert search.averages
    assert 1.0 < float(search.x[:3].min()) <= float(search.x[:3].max()) <= 1.2
    assert float((search.x - target)[3:].square().mean()) < 0.03


def test_an_output_at_which_the_loss_is_not_finite_is_no_end_of_a_step():
    search = search_for(lambda y: y.sum().log())
    known = averaging(search_for())
    points = torch.cat([known.center.expand(2, -1), known.center + 0.1 * normal(60, N)])
    below = replace(told(points, known.shape), outputs=-image(points).flatten(1).square())
    after = search._method.sampled(known, below)
    assert torch.equal(after.center, known.before.point)
    first = replace(known, before=None)
    after = search._method.sampled(first, below)
    assert torch.equal(after.center, known.center)
    assert len(after.points) > len(known.points)


def test_curvature_along_the_slopes_is_no_part_of_the_constant():
    """Outputs 0.3 + t + 0.5 t^2 with t = N(0, 1): a mean of the rest is 0.8."""
    t = normal(100, 30)
    constant, rest, count = constants(t, 0.3 + 0.5 * t.square(), 30)
    torch.testing.assert_close(constant, torch.full((30,), 0.3).double())
    assert rest == pytest.approx(0.0, abs=1e-12)
    assert count == pytest.approx(100 / 1.5, rel=0.1)
    error = 0.1 * normal(100, 30, seed=1)
    constant, rest, count = constants(t, 0.3 + error, 30)
    torch.testing.assert_close(constant, 0.3 + error.mean(0))
    assert rest == pytest.approx(0.01, rel=0.1)
    assert count == 100.0


def test_outputs_at_the_center_count_where_curvature_has_moved_the_constant():
    """Two outputs have half of the variance. Where the constant is off by b, their weight is b^2 / (b^2 + 1/2)."""
    search = search_for()
    known = replace(averaging(search), variance=1.0, pairs=1)
    apart = torch.ones_like(known.output)
    for off, weight in ((10.0, 0.995), (0.8, 0.0)):
        output, variance = search._method.averaging.combined(known, 1000, (known.output + off * apart).expand(2, -1))
        torch.testing.assert_close(output, known.output + weight * off * apart, atol=1e-3, rtol=0.0)
        assert variance == pytest.approx(weight * 0.5 or 1e-3, rel=1e-2)
    assert search._method.averaging.combined(known, 1000, known.outputs[:0])[1] == 1e-3


def test_the_error_of_a_loss_by_noise():
    """The gradient times the noise; and noise raises a mean of squares by its variance."""
    search = search_for()
    known = averaging(search)
    slope = 2.0 * (known.output - TARGET.flatten()) / N
    known = replace(known, loss=float((known.output - TARGET.flatten()).square().mean()))
    assert search._method.averaging.error(known, 0.04) == pytest.approx(0.2 * float(slope.norm()))
    assert search._method.averaging.raised(known, 0.04) == pytest.approx(0.04)


def test_the_promise_is_what_the_last_step_is_to_achieve():
    search = search_for()
    known = averaging(search)
    known = replace(known, radius=100.0)
    assert search._method.promise(known) == pytest.approx(known.before.loss - known.loss)
    assert search._method.promise(replace(known, radius=1e-3)) == math.inf
    assert search._method.promise(replace(known, before=None)) == math.inf
    assert search._method.promise(replace(known, jacobian=replace(known.jacobian, explained=0.4))) == math.inf


@pytest.mark.parametrize(("achieved", "factor"), [(0.9, 2.0), (0.5, 1.0), (0.1, 0.5)])
def test_the_radius_follows_what_a_step_achieves(achieved, factor):
    search = search_for()
    known = averaging(search)
    known = replace(known, radius=0.5, before=replace(known.before, loss=1.0), loss=1.0 - 0.8 * achieved)
    assert search._method.averaging.radius(known, 0.2, 1e-3) == pytest.approx(0.5 * factor)
    assert search._method.averaging.radius(known, 0.2, 0.9) == 0.5  # noise may have achieved that
    assert search._method.averaging.radius(replace(known, radius=1.9), 0.2, 1e-3) <= 2.0


def test_steps_are_short_along_directions_that_noise_hides():
    """A texel whose slopes have large errors moves less."""
    search = search_for()
    known = begun(search)
    sure = known.jacobian.standard_error
    errors = torch.where(known.jacobian.index < 10, 1.0, 1e-4).to(sure)
    known = replace(known, jacobian=replace(known.jacobian, standard_error=errors), radius=10.0)
    known = replace(known, output=torch.ones(N).double() + TARGET.flatten())
    step = step_in_noise(known, search._method.settings).abs()
    assert float(step[:10].max()) < 0.6
    assert float(step[10:].min()) > 0.9


def test_steps_are_solved_where_sizes_of_texels_differ():
    """Along the gradient alone the loss of the linear outputs would hardly fall for the small ones."""
    sizes = torch.linspace(1.0, 10.0, N).double()
    search = search_for(square(0.0))
    search.tell(image(search.ask() * sizes))
    known = search._state.progress
    known = replace(known, output=sizes, radius=10.0)
    step = step_in_noise(known, search._method.settings)
    assert float((known.output + known.jacobian.matvec(step).flatten()).norm()) < 0.1 * float(sizes.norm())


def test_bounds_are_kept():
    seen = []
    f = noisy()
    search = run(search_for(bounds=(-0.3, 0.3)), lambda x: f(seen.append(x) or x), 400)
    assert float(torch.cat(seen).abs().max()) <= 0.3
    torch.testing.assert_close(search.x, TRUTH.clamp(-0.3, 0.3), atol=0.05, rtol=0.0)


def test_a_state_can_be_saved():
    f = noisy()
    door = {"sigma": 1.0, "loss": square(TARGET), "noise": NOISE, "seed": 0}
    for make in (search_for, lambda: TrustRegion(torch.zeros(N).double(), **door)):
        search, again = make(), make()
        run(search, f, 140)
        again.load_state_dict(search.state_dict())
        values = f(search.ask())
        search.tell(values)
        again.tell(values)
        assert torch.equal(search.ask(), again.ask())
    assert search.engine == "local"


def test_batches_of_one_and_values_that_are_not_finite():
    search, f = search_for(), noisy()
    for one in range(25):
        values = f(search.ask(limit=1 if one % 7 == 6 else None))
        values[0] = math.nan if one % 5 == 1 else values[0]
        search.tell(values)
    assert excess(search.x) < 0.05
    assert bool(search._state.progress.evidence.sums.isfinite().all())


def test_the_region_is_as_wide_as_the_last_step():
    search = search_for()
    known = averaging(search)
    length = float((known.center - known.before.point).norm()) / math.sqrt(N)
    torch.testing.assert_close(search._method.width(known), torch.full((N,), length).double())
    assert bool(search._method.width(replace(known, before=None)).isinf().all())
    known = replace(known, jacobian=replace(known.jacobian, explained=0.4))
    assert bool(search._method.width(known).isinf().all())


def test_an_output_of_one_number_is_refused():
    search = search_for(torch.sum)
    with pytest.raises(ValueError, match="got an output of one number: use engine='descent'"):
        search.tell(search.ask().sum(1, keepdim=True))
