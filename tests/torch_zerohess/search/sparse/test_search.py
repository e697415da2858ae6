"""Local Gauss-Newton, and the choice by evidence, on problems whose solution is known in closed form."""

import math
from dataclasses import replace

import pytest
import torch
from searches import SIDE, N, run, square, zeros
from searches import texels as image

import torch_zerohess as zh
from torch_zerohess.optim import LocalGaussNewton
from torch_zerohess.search.gauss_newton.by_samples import STEP_LENGTHS
from torch_zerohess.search.protocol.state import Arrivals, Evaluated
from torch_zerohess.search.sparse import arrival
from torch_zerohess.search.sparse.steps import sparse_steps
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from truths import normal, vector


def blur(x):
    """Pixels [12, 12] of nine texels each, as a matrix whose condition number is 2."""
    return image(x) + torch.nn.functional.avg_pool2d(image(x), 3, 1, 1)


def search_for(f, truth, **settings):
    settings = {"sigma": 1.0, "loss": square(f(truth[None])[0]), "seed": 7} | settings  # samples are not the truth
    return LocalGaussNewton(torch.zeros(len(truth)).double(), **settings)


def test_texels_are_found_after_one_batch_of_samples():
    """39 evaluations for 144 parameters: the start, 32 samples and the steps."""
    search = run(search_for(image, normal(N)), image, 39)
    assert search.value < 1e-4
    assert search.jacobian.explained > 0.99
    torch.testing.assert_close(search.jacobian.dense().view(N, N), torch.eye(N), atol=1e-2, rtol=0)


def rough(x):
    """A ripple in every pixel that is as large as the texel, and that samples do not resolve."""
    return image(x) + torch.sin(40 * image(x))


@pytest.mark.parametrize(("f", "radius", "asked"), [(image, 1.0, 6), (rough, 0.5, 32)])
def test_a_jacobian_that_predicts_well_is_trusted_in_long_steps_and_kept(f, radius, asked):
    """Its first steps are twice as long, and further steps follow them; otherwise samples do."""
    search = search_for(f, 3 * normal(N))
    search.tell(f(search.ask()))
    points = search.ask()
    lengths = (points - search.center).norm(dim=1) / math.sqrt(N)
    assert lengths.tolist() == pytest.approx([radius * one for one in STEP_LENGTHS])
    search.tell(f(points))
    assert len(search.ask()) == asked


def test_the_model_is_one_at_the_best_sample():
    truth = normal(N)
    search = search_for(image, truth, sigma=0.1)
    search.tell(image(search.ask()))
    assert not torch.equal(search.x, search.center)
    found = search.model_at_best()
    assert found is not None
    model, sigma = found
    assert model.value == pytest.approx(search.value, rel=1e-4)
    torch.testing.assert_close(model.gradient / (0.1 * sigma), 2.0 * (search.x - truth) / N, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("samples", "gain", "after"),
    [(32, 0.01, 64), (32, 0.05, 32), (64, 0.01, 64), (64, 0.05, 64), (64, 0.2, 32)],
)
def test_samples_are_doubled_after_a_small_gain_and_halved_after_a_large_one(samples, gain, after):
    search = search_for(image, normal(N))
    search.tell(image(search.ask()))
    known = search._state.progress
    assert stepped(search, replace(known, samples=samples), gain).samples == after


def stepped(search, known, gain):
    """The progress after a step that lowers the loss by a share of it."""
    told = Evaluated(known.center[None] + 0.1, vector((1 - gain) * known.loss), known.output[None], known.shape)
    return search._method.taken(known, told)


def two_minima(x):
    """Two pixels of each texel: zero at 0.2, and a local minimum of their squares at -0.2."""
    return torch.cat([10 * (image(x).square() - 0.04), image(x) - 0.2], 1)


def test_hops_leave_local_minima():
    """Without them the loss is 0.067 or more."""
    search = LocalGaussNewton(torch.full((N,), -0.3).double(), sigma=1.0, loss=square(0.0), seed=0, restarts=100)
    assert run(search, two_minima, 600).value < 0.05


def slow(search, black_box=image):
    """The progress after the first samples and one step of a small gain."""
    search.tell(black_box(search.ask()))
    return stepped(search, search._state.progress, 0.01)


def test_after_two_small_gains_it_hops():
    search = search_for(image, normal(N))
    once = slow(search)
    assert once.home is None
    assert stepped(search, stepped(search, once, 0.05), 0.01).home is None  # not in a row
    twice = stepped(search, once, 0.01)
    known, points = search._method.samples(twice, torch.Generator().manual_seed(0))
    assert torch.equal(points[0], known.center)
    steps = points[0] - twice.home.center
    assert float(steps.square().mean().sqrt()) == pytest.approx(0.3, rel=0.2)
    distances = (points[1:] - points[0]).square().mean(1).sqrt()
    torch.testing.assert_close(distances, known.sigma * torch.ones(32).double(), rtol=0.3, atol=0.0)


def test_a_hop_leaves_parameters_that_no_output_depends_on():
    search = LocalGaussNewton(torch.zeros(N + 10).double(), sigma=1.0, loss=square(image(normal(1, N))[0]), seed=0)
    hopped = stepped(search, slow(search, lambda x: image(x[:, :N])), 0.01)
    left = search.untouched
    assert torch.equal(left.nonzero()[:, 0], torch.arange(N, N + 10))
    known, _ = search._method.samples(hopped, torch.Generator().manual_seed(0))
    assert bool((known.center == hopped.home.center)[left].all())
    assert not bool((known.center == hopped.home.center)[~left].any())


def hopping(search, finished=False):
    """The progress at the start of a hop, whose loss is twice the one before."""
    home = replace(slow(search), finished=finished)
    return replace(home, home=home, loss=2.0 * home.loss, hopped=2.0 * home.loss)


def test_a_hop_that_finds_nothing_better_is_undone_and_slow_steps_go_on():
    search = search_for(image, normal(N))
    known = hopping(search)
    back = stepped(search, known, 0.01)
    assert torch.equal(back.center, known.home.center)
    assert back.loss == known.home.loss
    assert back.evaluations == known.evaluations
    assert back.iterations == known.iterations + 1
    on = stepped(search, stepped(search, back, 0.01), 0.01)
    assert on.home is None
    assert on.rounds == 0


def test_a_hop_that_finds_something_better_is_kept():
    search = search_for(image, normal(N))
    known = hopping(search)
    after = stepped(search, stepped(search, known, 0.6), 0.01)
    assert after.loss < known.home.loss
    assert stepped(search, after, 0.01).home.loss < known.home.loss  # it hops from there


@pytest.mark.parametrize(("above", "agreed"), [(0.005, 2), (0.02, 0)])
def test_a_hop_that_returns_to_a_minimum_confirms_it(above, agreed):
    search = search_for(image, normal(N))
    known = hopping(search, finished=True)
    home = replace(known.home, best=replace(known.best, point=known.home.center))
    arrivals, loss = Arrivals(place=home.best, agreed=1), (1.0 + above) * home.loss
    known = replace(known, home=home, best=home.best, arrivals=arrivals, loss=loss)
    after = search._method.arrived(known)
    assert after.agreed == agreed
    assert after.rounds == 1
    assert torch.equal(after.home.center, home.center)  # the next hop is from the same point


def test_a_hop_to_where_there_is_no_value_is_undone():
    search = search_for(image, normal(N))
    known = replace(stepped(search, slow(search), 0.01), evaluations=33)
    points = known.center.expand(33, N)
    outputs = image(points).flatten(1).clone()
    outputs[0] = math.nan
    told = Evaluated(points, outputs.square().mean(1), outputs, known.shape)
    back = search._method.sampled(known, told)
    assert back.home is None
    assert torch.equal(back.center, known.home.center)
    assert back.agreed == 0


def test_the_model_is_one_of_the_minimum_while_the_search_hops():
    search = search_for(image, normal(N))
    known = hopping(search)
    away = replace(known, center=known.center + 5.0, best=replace(known.best, point=known.home.center))
    model, _ = search._method.model_at_best(away)
    assert model.value == pytest.approx(known.home.loss)


def test_a_state_in_a_hop_can_be_saved():
    search = LocalGaussNewton(torch.full((N,), -0.3).double(), sigma=1.0, loss=square(0.0), seed=0)
    while search._state.progress.home is None:
        search.tell(two_minima(search.ask()))
    again = LocalGaussNewton(torch.full((N,), -0.3).double(), sigma=1.0, loss=square(0.0), seed=5)
    again.load_state_dict(search.state_dict())
    until = search.evaluations + 100
    for one in (search, again):
        run(one, two_minima, until)
    assert torch.equal(search.ask(), again.ask())


def test_steps_are_solved_where_sizes_of_texels_differ():
    """The condition number of the Hessian is 100: along the gradient alone the loss would fall by a third."""
    sizes = torch.linspace(1.0, 10.0, N).double().view(SIDE, SIDE)
    truth = normal(N)
    search = run(search_for(lambda x: sizes * image(x), truth), lambda x: sizes * image(x), 39)
    assert search.value < 1e-3 * float((sizes * image(truth[None])).square().mean())


def test_no_hessian_is_formed_for_more_than_a_thousand_parameters():
    for n in (1000, 1001):
        method = LocalGaussNewton(torch.zeros(n).double(), sigma=1.0, loss=square(0.0))._method
        jacobian = SparseJacobian.empty(n, (2,), 1, torch.zeros(1))
        known = replace(method.begun(), jacobian=jacobian, output=vector(1.0, 2.0), shape=torch.Size([2]))
        assert (method.derivatives_at_center(known) is not None) == (n == 1000)


@pytest.mark.parametrize(("explained", "agreed"), [(0.4, 0), (0.6, 1)])
def test_the_end_of_a_round_is_a_minimum_where_the_jacobian_predicts(explained, agreed):
    search = run(search_for(image, normal(N)), image, 39)
    known = search._state.progress
    known = replace(known, jacobian=replace(known.jacobian, explained=explained))
    assert search._method.arrived(known).agreed == agreed


def test_overlapping_footprints():
    """Seven batches of samples and steps, where a dense Jacobian takes 145 evaluations before the first step."""
    truth = normal(N)
    search = run(search_for(blur, truth, grid=(SIDE, SIDE)), blur, 150)
    assert search.value < 1e-3 * float(square(blur(truth[None])[0])(torch.zeros(SIDE, SIDE).double()))


def wide(x):
    """Pixels [14, 14] of 25 texels each."""
    texels = x.view(-1, 1, 14, 14)
    return (0.3 * texels + torch.nn.functional.avg_pool2d(texels, 5, 1, 2))[:, 0]


def test_full_rows_and_a_grid_of_parameters_are_found():
    """25 entries per row, where 16 are kept at first. Neighbours show them, although nobody says that they are some."""
    truth, order = normal(196), torch.randperm(196, generator=torch.Generator().manual_seed(0))
    least = 1e-4 * float(wide(truth[None]).square().mean())
    open_, few = (run(search_for(wide, truth, **one), wide, 300, least).evaluations for one in ({}, {"keep": 16}))
    assert open_ <= 160
    assert few >= open_ + 50
    mixed = run(search_for(lambda x: wide(x[:, order]), truth), lambda x: wide(x[:, order]), 300, least)
    assert mixed.evaluations >= open_ + 30


def test_steps_in_the_output_are_crossed():
    """Each pixel is a staircase of its texel, whose own derivative is zero."""

    def stairs(x):
        return (4 * image(x)).round() / 4

    truth = normal(N).clamp(-1.5, 1.5)
    search = run(search_for(stairs, truth, least_sigma=0.3, share=1.0), stairs, 300)
    assert search.value < 0.25**2


def test_any_smooth_loss():
    """A loss whose second derivative is no multiple of the identity: log cosh."""
    truth = 0.5 * normal(N)
    loss = lambda y: (y - image(truth[None])[0]).cosh().log().sum()  # noqa: E731
    search = run(search_for(image, truth, loss=loss), image, 60)
    assert float((search.x - truth).abs().max()) < 0.02


def test_bounds_are_kept_and_hold_parameters():
    truth = normal(N)
    seen = []

    def f(x):
        seen.append(x)
        return image(x)

    search = run(search_for(image, truth, bounds=(-0.5, 0.5)), f, 120)
    every = torch.cat(seen)
    assert float(every.abs().max()) <= 0.5
    torch.testing.assert_close(search.x, truth.clamp(-0.5, 0.5), atol=0.05, rtol=0)


@pytest.mark.parametrize(("engine", "seed"), [("local", 0), ("auto", 1)])
@pytest.mark.parametrize("f", [lambda x: x[:, :60], lambda x: x[:, :60].tanh()], ids=["linear", "tanh"])
def test_parameters_that_no_pixel_depends_on_stay_and_are_named(f, engine, seed):
    """Through hops, and where the target is out of reach, so that samples beat the center and hops end near it.

    By chance one or two without effect may be moved.
    """
    start = torch.linspace(0.1, 0.9, 100).double()  # some of these numbers change when divided by 0.7 and multiplied
    settings = {"sigma": 0.7, "loss": square(-2.0), "seed": seed, "max_evaluations": 300}
    fit = zh.minimize(lambda x: f(x).view(-1, 6, 10), start, engine=engine, **settings)
    moved = fit.x != start
    assert moved[:60].all()
    assert int(moved[60:].sum()) <= 2
    first = ", ".join(str(60 + k) for k in (~moved[60:]).nonzero()[:5, 0].tolist())
    said = f"; {int((~moved).sum())} of 100 parameters ({first}, ...) were not found to change any output, and stay"
    assert fit.message.endswith(said)


def parabolas(x):
    """No slope tells that outputs depend on a parameter at 0. There the loss is at a maximum."""
    return x.square() - 1.0


@pytest.mark.parametrize("seed", range(1, 4))
def test_parameters_that_change_outputs_without_a_slope_are_moved(seed):
    fit = zh.minimize(parabolas, zeros(100), sigma=0.1, loss=square(0.0), seed=seed)
    assert fit.success
    assert fit.value < 1e-6
    assert fit.x.abs().tolist() == pytest.approx([1.0] * 100, abs=1e-2)


@pytest.mark.parametrize("sigma", [0.1, 0.5])
@pytest.mark.parametrize("start", [(0.01, 0.5), (0.0, 0.5)])
def test_a_start_at_a_maximum_is_not_solved(start, sigma):
    for seed in range(2):
        settings = {"sigma": sigma, "loss": square(0.0), "seed": seed, "restarts": 0, "max_evaluations": 300}
        fit = zh.minimize(parabolas, vector(*start), engine="local", **settings)
        assert not fit.success or fit.value < 1e-4


def test_parameters_without_effect_take_two_evaluations():
    start, settings = zeros(100), {"sigma": 1.0, "seed": 0, "restarts": 0, "max_evaluations": 300}
    fit = zh.minimize(lambda x: x[:, :60] - 1.0, start, loss=square(0.0), engine="local", **settings)
    aside = (fit.points[:, 60:] != 0.0).any(1) & (fit.points[:, :60] == fit.x[:60]).all(1)
    assert int(aside.sum()) == 2
    assert torch.equal(fit.x[60:], start[60:])
    assert "40 of 100 parameters" in fit.message


def test_a_look_at_parameters_that_stay_survives_in_a_state():
    def search():
        return LocalGaussNewton(vector(0.0, 0.5), sigma=0.5, loss=square(0.0), restarts=0, seed=2)

    one, looked = search(), 0
    while not one.done:
        one.tell(parabolas(one.ask()))
        looked += one._state.progress.phase == "aside"
        other = search()
        other.load_state_dict(one.state_dict())
        assert one.done or torch.equal(one.ask(), other.ask())
        one = other
    assert looked == 1
    assert one.value < 1e-6


def test_parameters_that_no_pixel_depends_on_stay_in_noise():
    """Also in the decision at the end, whose candidates are points with low values: samples, too."""
    generator, start = torch.Generator().manual_seed(0), torch.full((100,), 0.3).double()

    def noisy(x):
        return x[:, :60].view(-1, 6, 10) + 0.3 * torch.randn(len(x), 6, 10, generator=generator, dtype=torch.float64)

    fit = zh.minimize(noisy, start, sigma=0.5, loss=square(0.0), engine="local", seed=0, max_evaluations=200)
    assert fit.noise > 0.0
    assert torch.equal(fit.x[60:], start[60:])
    assert not torch.equal(fit.x[:60], start[:60])


def test_a_dense_map_calls_no_parameter_untouched():
    search = run(search_for(lambda x: x @ normal(N, N), normal(N)), lambda x: x @ normal(N, N), 80)
    assert search.untouched is None


def test_where_few_parameters_are_found_more_samples_follow():
    """A perfect fit would predict a third of the change."""
    search, generator = search_for(image, normal(N)), torch.Generator().manual_seed(0)
    points = search.ask()
    noise = 1.4 * torch.randn(33, SIDE, SIDE, generator=generator, dtype=torch.float64)
    search.tell(image(points) + noise)
    assert search.ask().shape == (64, N)


@pytest.mark.parametrize(("gain", "failed"), [(1e-14, True), (1e-9, False)])
def test_a_hop_that_lowers_the_loss_by_rounding_alone_has_failed(gain, failed):
    known = hopping(search_for(image, normal(N)))
    assert replace(known, loss=(1 - gain) * known.home.loss).failed == failed
    low = replace(known, home=replace(known.home, loss=gain), loss=0.0, hopped=1.0)  # to where rounding is all there is
    assert low.failed == failed


def test_noise():
    """Pixels with an error of 0.05: the loss ends near its square."""
    generator, truth = torch.Generator().manual_seed(7), normal(N)

    def noisy(x):
        return image(x) + 0.05 * torch.randn(len(x), SIDE, SIDE, generator=generator, dtype=torch.float64)

    search = run(search_for(image, truth), noisy, 150)
    assert float((search.x - truth).square().mean()) < 4 * 0.05**2


def test_values_that_are_not_finite_are_avoided():
    truth = normal(N)

    def hole(x):
        return torch.where((x.norm(dim=1) > 1.05 * math.sqrt(N))[:, None, None], math.nan, image(x))

    search = run(search_for(image, truth), hole, 150)
    assert search.value < 1e-2


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"loss": None}, "loss must be a function of one output for the engine 'local', got None"),
        ({"keep": 0}, "keep must be between 1 and the number of parameters, 144, got 0"),
        ({"keep": 40}, r"samples must be at least 42 to fit 40 parameters per output \(keep\), got 32"),
        ({"rate": 1.0}, "rate must be positive and below 1, got 1.0"),
        ({"grid": (12, 13)}, r"grid must be rows and columns \(and channels\) of 144 parameters, got \(12, 13\)"),
        ({"radius": 0.0}, "radius must be positive and finite, got 0.0"),
        ({"share": 2.0}, "share must be positive and at most 1, got 2.0"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        search_for(image, normal(N), **settings)


def test_samples_are_whole():
    with pytest.raises(TypeError, match=r"samples must be an integer, got 20\.5"):
        search_for(image, normal(N), samples=20.5)


def test_an_output_of_one_number_is_refused():
    search = LocalGaussNewton(torch.zeros(N).double(), sigma=1.0, loss=torch.sum, seed=0)
    with pytest.raises(ValueError, match="got an output of one number: use engine='descent'"):
        search.tell(search.ask().sum(1, keepdim=True))


@pytest.mark.parametrize("scale", [1e42, 1e-42])
def test_outputs_beyond_float32_are_refused_and_left_to_the_descent(scale):
    def scaled(x):
        return scale * image(x)

    start, loss = torch.zeros(N).double(), lambda y: (y / scale - 1.0).square().mean()
    search = LocalGaussNewton(start, sigma=1.0, loss=loss, seed=0)
    with pytest.raises(ValueError, match=r"computes in float32, .*e[+-]42: return them in other units"):
        search.tell(scaled(search.ask()))
    search = zh.optim.TrustRegion(start, sigma=1.0, loss=loss, seed=0)
    assert run(search, scaled, 2 * N).value < 1e-4
    assert search.engine == "descent"


def test_minimize_takes_it():
    truth = normal(N)
    fit = zh.minimize(
        image, torch.zeros(N).double(), sigma=1.0, loss=square(image(truth[None])[0]), target=1e-4, seed=7
    )
    assert fit.engine == "local"
    assert fit.evaluations <= 45
    # The loss is mean((x - truth)^2): its Hessian is 2 / n on the diagonal.
    torch.testing.assert_close(fit.hessian, 2 / N * torch.eye(N).double(), atol=1e-3, rtol=0)


def test_three_parameters_may_all_count_for_an_output():
    search = zh.optim.LocalGaussNewton(torch.zeros(3), sigma=0.1, loss=lambda y: y.square().mean())
    assert search.ask().shape == (33, 3)  # the start and its samples


def thrice(x):
    """Three pixels of each texel."""
    return torch.cat([image(x), image(x), image(x)], 1)


TARGETS = normal(3 * SIDE, SIDE, seed=2)
MEDIANS = TARGETS.view(3, N).median(0).values
LEAST = float((thrice(MEDIANS[None])[0] - TARGETS).abs().mean())


def magnitudes(y):
    """The mean of magnitudes, which is least where each texel is the median of its three targets."""
    return (y - TARGETS).abs().mean()


def test_a_mean_of_magnitudes_falls_to_zero_in_as_many_evaluations_as_a_mean_of_squares():
    truth = normal(N)
    loss = lambda y: (y - blur(truth[None])[0]).abs().mean()  # noqa: E731
    target = 1e-3 * float(loss(blur(torch.zeros(1, N).double())[0]))
    search = run(search_for(blur, truth, loss=loss, grid=(SIDE, SIDE)), blur, 150, target)
    assert search.value <= target


def test_the_minimum_of_a_mean_of_magnitudes_is_found_and_confirmed():
    """Three rounds arrive there. Where nothing is promised no step is tried: no point is evaluated twice."""
    seen = []
    fit = zh.minimize(
        lambda x: seen.append(x) or thrice(x),
        torch.zeros(N).double(),
        sigma=1.0,
        loss=magnitudes,
        engine="local",
        seed=0,
        max_evaluations=600,
    )
    assert fit.success
    assert fit.message == "3 rounds in a row have arrived at x"
    assert fit.evaluations < 400
    assert fit.value < LEAST + 0.01 * (float(magnitudes(0.0 * TARGETS)) - LEAST)
    assert len(torch.cat(seen).unique(dim=0)) == fit.evaluations - 2  # the start and x, to look for noise


def kinked(x, size=1.0):
    """The progress of a search at x [N], with samples nearby and a Jacobian that is exact times `size`."""
    search = search_for(thrice, normal(N), loss=magnitudes)
    search.tell(thrice(search.ask()))
    known = search._state.progress
    every = torch.arange(N).repeat(3)[:, None]
    exact = SparseJacobian(every, size * torch.ones(3 * N, 1), torch.zeros(3 * N, 1), N, known.shape, explained=1.0)
    output = thrice(x[None])[0]
    loss = float(magnitudes(output))
    known = replace(known, jacobian=exact, center=x, output=output.flatten(), loss=loss, sigma=0.03)
    return search._method, replace(known, radius=1e-4, phase="trial")


@pytest.mark.parametrize(("away", "size", "agreed"), [(0.0, 1.0, 1), (0.5, 1.0, 0), (0.5, 1e-6, 1)])
def test_short_steps_at_a_kink_are_an_arrival_where_the_loss_of_linear_outputs_promises_nothing(away, size, agreed):
    """Half a unit beside the minimum the loss falls along the whole step; next to not, where outputs hardly change."""
    method, known = kinked(MEDIANS + away, size)
    known = replace(known, best=replace(known.best, point=known.center, loss=known.loss))
    after = method.arrived(known)
    assert after.agreed == agreed
    assert (after.arrivals.lowest is not None) == (agreed == 1)


def test_samples_at_the_center_are_asked_for_before_it_arrives_with_a_jacobian_that_is_not_exact():
    method, known = kinked(MEDIANS)
    after = method.arrived(replace(known, jacobian=replace(known.jacobian, explained=0.9)))
    assert after.phase == "sample"
    assert after.rounds == 0
    assert method.arrived(replace(known, missed=0.1)).rounds == 0


def test_at_a_kink_nearer_samples_are_asked_for_before_it_arrives():
    method, known = kinked(MEDIANS)
    generator = torch.Generator().manual_seed(0)
    wide = replace(known, sigma=0.35, radius=1.0)
    nearer, points = method.asked(wide, generator)
    assert (nearer.phase, nearer.rounds, len(points)) == ("sample", 0, 32)
    assert nearer.sigma == pytest.approx(0.03)
    assert method.asked(replace(known, radius=0.05), generator)[0].rounds == 1


def test_the_promise_at_a_kink_is_the_decrease_of_the_loss_of_linear_outputs():
    """Within the longest step; a minimum farther away promises an unknown decrease."""
    method, known = kinked(MEDIANS + 0.01)
    assert method.promise(known) == math.inf
    known = replace(known, radius=0.1)
    assert method.promise(known) == pytest.approx(known.loss - LEAST, rel=0.02)


def test_a_promise_takes_no_more_solutions_than_the_steps_do(monkeypatch):
    """A callback or a tolerance of the loss reads the promise of every batch of steps."""
    solved = []
    monkeypatch.setattr(arrival, "sparse_steps", lambda *args: solved.append(args) or sparse_steps(*args))
    search = search_for(image, normal(N))
    search.tell(image(search.ask()))
    assert search.promise < math.inf
    assert len(search.ask()) == len(STEP_LENGTHS)
    assert len(solved) == 1
