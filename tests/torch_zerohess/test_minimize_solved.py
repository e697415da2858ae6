"""What `minimize` calls solved: rounds that agree. Plateaus, jumps, cusps and falling losses are no evidence."""

import itertools
import math

import pytest
import torch
from searches import bars, square, sum_of_squares, tilted, zeros

import torch_zerohess as zh


def test_a_convex_function_ends_when_three_rounds_agree():
    fit = zh.minimize(tilted, zeros(2), sigma=2.0, seed=0)
    assert (fit.status, fit.success) == ("solved", True)
    assert fit.message == "3 rounds in a row have arrived at x"
    assert fit.evaluations < 150


CENTER = torch.tensor([0.4, -0.3], dtype=torch.float64)


identity_misfit = sum_of_squares(CENTER)


@pytest.mark.parametrize(
    ("fn", "dtype", "settings", "rounds", "most"),
    [
        (lambda z: 0.5 + (z - CENTER.to(z)).square().sum(1), torch.float32, {}, 3, 80),
        (lambda z: z, torch.float64, {"loss": lambda y: 0.5 + identity_misfit(y)}, 3, 300),
        (lambda z: z, torch.float64, {"loss": identity_misfit}, 2, 200),
        (lambda z: z, torch.float64, {"loss": identity_misfit, "bounds": (-5.0, 5.0)}, 2, 200),
        (lambda z: (z - CENTER).square().sum(1), torch.float64, {"bounds": (-5.0, 5.0)}, 2, 200),
        (lambda z: (z - CENTER).square().sum(1) - 1e-9, torch.float64, {"bounds": (-5.0, 5.0)}, 3, 250),
    ],
    ids=["float32", "output", "exact output", "exact output in a box", "zero in a box", "negative in a box"],
)
def test_every_search_ends_when_rounds_agree(fn, dtype, settings, rounds, most):
    """Three of them, or two where the loss has fallen to zero and none was negative."""
    fit = zh.minimize(fn, zeros(2, dtype), sigma=1.0, seed=0, max_evaluations=400, **settings)
    assert (fit.status, fit.success, fit.message) == ("solved", True, f"{rounds} rounds in a row have arrived at x")
    assert fit.evaluations < most
    assert float((fit.x.double() - CENTER).norm()) < 1e-3


def sum_of_one(z):
    """Zero on a plane."""
    return (z.sum(1) - 1.0).square()


def ring(z):
    """Zero on a sphere."""
    return (z.square().sum(1) - 1.0).square()


def first_two(z):
    """Only two parameters change anything."""
    return (z[:, :2] - CENTER).square().sum(1)


@pytest.mark.parametrize(
    ("fn", "n", "settings"),
    [
        (sum_of_one, 2, {}),
        (sum_of_one, 2, {"bounds": (-3.0, 3.0)}),
        (ring, 3, {}),
        (first_two, 10, {}),
        (lambda z: z[:, :2] - CENTER, 4, {"loss": lambda output: output.square().sum()}),
    ],
    ids=["plane", "plane in a box", "sphere", "unused", "unused of the output"],
)
def test_a_minimum_that_is_not_unique_is_found_once_and_said(fn, n, settings):
    """Rounds from random points arrive at many points of a valley, all with the same loss."""
    start = torch.full((n,), 1.5, dtype=torch.float64)
    fit = zh.minimize(fn, start, sigma=1.0, seed=0, max_evaluations=2000, **settings)
    assert (fit.status, fit.success) == ("solved", True)
    assert "the minimum is not unique" in fit.message
    assert fit.evaluations < 1200
    assert fit.value < 1e-16


@pytest.mark.parametrize(
    ("cases", "bounds", "local", "default"),
    [([(1, 2), (1, 6), (3, 6)], None, 4, 4), ([(1, 2)] * 2, (-5.0, 5.0), 2, 3)],
    ids=["free", "box"],
)
def test_a_minimum_is_one_where_parameters_have_no_effect(cases, bounds, local, default):
    """All values along these parameters are equal, and the loss at the minimum is 1.

    Of 6 runs without a box, and of 4 in a box, at least `local` of `restarts=0` are solved, and at least `default` of
    the others, with fewer than 600 evaluations. Steps that arrive at the minimum exactly evaluate nothing else next to
    it: such a round may not count.
    """
    solved = {0: 0, None: 0}
    for k, (unused, n) in enumerate(cases):
        scale = torch.linspace(1.0, 3.0, n - unused, dtype=torch.float64)

        def fn(z, unused=unused, scale=scale):
            return 1.0 + ((z[:, unused:] - 3.0).square() * scale).sum(1)

        settings = {"sigma": 1.0, "bounds": bounds, "max_evaluations": 599}
        for restarts, seed in itertools.product(solved, range(4 * k, 4 * k + 2)):
            fit = zh.minimize(fn, zeros(n), restarts=restarts, seed=seed, **settings)
            assert float((fit.x[unused:] - 3.0).abs().max()) < 1e-6
            solved[restarts] += fit.status == "solved"
    assert solved[0] >= local
    assert solved[None] >= default


@pytest.mark.parametrize("bounds", [None, (-5.0, 5.0)])
def test_a_floor_is_no_agreement(bounds):
    """All points of a ball have the lowest loss, exactly: a plateau may lie beside something lower."""
    start, settings = torch.full((2,), -1.5, dtype=torch.float64), {"sigma": 1.0, "seed": 0, "bounds": bounds}
    arrived = zh.minimize(ring, start, max_evaluations=1200, **settings)
    assert arrived.status == "solved"
    most = 2 * arrived.evaluations
    floor = zh.minimize(lambda z: (z.square().sum(1) - 1.0).clamp(min=0.0), start, max_evaluations=most, **settings)
    assert (floor.value, floor.status, floor.success) == (0.0, "budget", False)


def test_arrivals_at_a_worse_minimum_do_not_end_a_search_in_a_box():
    for seed in range(2):
        fit = zh.minimize(waved, -zeros(1) - 2.0, sigma=0.5, seed=seed, bounds=(-4.0, 4.0), max_evaluations=90)
        assert float(fit.x) == pytest.approx(2.0, abs=1e-2)


def waved(z):
    """A minimum of 0.5 near -2 and one of 0 at 2."""
    return torch.minimum((z[:, 0] + 2).square() + 0.5, 2 * (z[:, 0] - 2).square())


def test_a_plateau_is_no_agreement():
    for bounds in (None, (-5.0, 5.0)):
        search = zh.optim.TrustRegion(zeros(2), sigma=1.0, seed=0, bounds=bounds, restarts=99)
        for _ in range(40):
            search.tell(torch.ones(len(search.ask())))
            assert search.agreed == 0


def test_agreement_goes_on_from_a_state():
    settings = {"sigma": 1.0, "seed": 0, "loss": identity_misfit, "restarts": 99}
    search, again = (zh.optim.TrustRegion(zeros(2), **settings) for _ in range(2))
    while search.agreed < 1:
        search.tell(search.ask())
    again.load_state_dict(search.state_dict())
    while search.agreed < 2 and search.evaluations < 400:
        assert torch.equal(search.ask(), again.ask())
        search.tell(search.ask())
        again.tell(again.ask())
        assert search.agreed == again.agreed
    assert search.agreed == 2


@pytest.mark.parametrize(
    "settings", [{"xtol": 1e-2}, {"ftol": 1e-3}, {"restarts": 0}], ids=["xtol", "ftol", "restarts"]
)
def test_a_plateau_beside_a_jump_is_not_solved(settings):
    """A bar with hard edges: images do not change when a parameter changes a little."""
    picture = bars(torch.linspace(0.0, 1.0, 16, dtype=torch.float64))
    loss = square(picture(torch.tensor([[0.3, 0.5]]))[0])
    for seed in range(5):
        fit = zh.minimize(picture, [0.8, 0.2], sigma=0.3, loss=loss, seed=seed, **settings)
        assert not fit.success or fit.value == 0.0
        assert fit.success or "may be no minimum" in fit.message


@pytest.mark.parametrize("settings", [{"xtol": 1e-2}, {"ftol": 1e-4}], ids=["xtol", "ftol"])
def test_the_hessian_in_a_curved_valley_is_that_of_the_nearest_evaluations_that_tell_it(settings):
    """Steps along the valley say nothing about its walls.

    The standard errors do not contain how curvatures change within the evaluations that are fitted: some percents. One
    of five runs may miss more. Where ftol ends a run, few evaluations may be near x: then errors are up to a half.
    """

    def banana(z):
        return 100.0 * (z[:, 1] - z[:, 0].square()).square() + (1.0 - z[:, 0]).square()

    within = 0
    for seed in (0, 1, 3, 4, 6):
        fit = zh.minimize(banana, [-1.0, -1.0], sigma=0.5, seed=seed, **settings)
        expected = torch.func.hessian(lambda x: banana(x[None])[0])(fit.x)
        off, errors = (fit.hessian - expected).diagonal().abs(), fit.standard_errors["hessian_diagonal"]
        within += bool((off < torch.maximum(5 * errors, 0.03 * expected.diagonal())).all())
        assert bool((errors < (0.2 if "xtol" in settings else 0.6) * expected.diagonal()).all())
    assert within >= 4


def test_a_region_that_shrank_by_mistake_is_no_evidence():
    """A kink along a diagonal: models across it are wrong, and rejected steps shrink the region far from the minimum.

    No run calls such a point a minimum, and both do if the width of the region alone counts.
    """

    def kinked(z):
        return 100.0 * (z[:, 1] - z[:, 0]).abs() + (1.0 - z[:, 0]).square()

    for seed in range(2):
        fit = zh.minimize(kinked, zeros(2) - 1.0, sigma=2.0, seed=seed, xtol=0.03, max_evaluations=300)
        assert not fit.success or fit.value < 1e-2


@pytest.mark.parametrize("kind", [zh.optim.LocalGaussNewton, zh.optim.BlockGaussNewton])
def test_gauss_newton_says_that_it_has_arrived(kind):
    goal = torch.linspace(-0.7, 0.7, 64, dtype=torch.float64).view(8, 8)
    settings = {"sigma": 1.0, "loss": lambda y: (y - goal).square().mean(), "restarts": 0, "seed": 0}
    search = kind(zeros(64), **settings)
    while not search.done:
        search.tell(search.ask().tanh().view(-1, 8, 8))
    assert search.solved
    fit = zh.minimize(lambda z: z.tanh().view(-1, 8, 8), zeros(64), engine="local", **settings)
    assert (fit.status, fit.success) == ("solved", True)


@pytest.mark.parametrize("seed", range(3))
def test_a_model_of_few_evaluations_that_promises_nothing_does_not_end_it(seed):
    """Twelve parameters and the loss alone: the first models promise 1e-7 of .3 that are left."""
    rows = torch.randn(36, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    truth = torch.linspace(-1.0, 1.0, 12, dtype=torch.float64)

    def loss(z):
        return ((z - truth) @ rows.mT).square().mean(1) + 0.3 * torch.sin((z - truth) @ rows.mT).square().mean(1)

    fit = zh.minimize(loss, zeros(12), sigma=1.0, seed=seed, ftol=1e-4)
    assert fit.status == "solved"
    assert fit.value < 1e-3


def fails(z: torch.Tensor) -> torch.Tensor:
    return torch.where(z.sum(1) >= 1.0, z.square().sum(1), math.nan)


def is_cut_off(z: torch.Tensor) -> torch.Tensor:
    return torch.where(z.sum(1) >= 1.0, z.square().sum(1), 10.0)


def has_steps(z: torch.Tensor) -> torch.Tensor:
    return (10.0 * z[:, 0]).floor() / 10.0 + z[:, 1].abs() + 2.0 * z[:, 0].abs()


@pytest.mark.parametrize(
    ("fn", "engine"),
    [
        (fails, "descent"),
        (fails, "gaussian_process"),
        (is_cut_off, "gaussian_process"),
        (has_steps, "descent"),
    ],
)
def test_a_search_that_ends_at_a_jump_has_not_solved(fn, engine):
    settings = {"sigma": 0.5, "bounds": (-4.0, 4.0), "engine": engine, "restarts": 0, "max_evaluations": 400}
    found = zh.minimize(fn, torch.tensor([2.0, 1.5]).double(), seed=0, **settings)
    assert (found.status, found.success) == ("stalled", False)
    assert "fn jumps or fails next to x, which may be no minimum" in found.message


@pytest.mark.parametrize("engine", ["descent", "gaussian_process"])
@pytest.mark.parametrize(
    "fn",
    [
        lambda z: z.abs().sum(1),
        lambda z: 100.0 * (z[:, 1] - z[:, 0] ** 2) ** 2 + (1.0 - z[:, 0]) ** 2,
        lambda z: z[:, 0] ** 2 + 1e6 * z[:, 1] ** 2,
    ],
)
def test_kinks_and_narrow_valleys_are_no_jumps(fn, engine):
    settings = {"sigma": 0.5, "bounds": (-4.0, 4.0), "engine": engine, "restarts": 0, "max_evaluations": 400}
    found = zh.minimize(fn, torch.tensor([2.0, 1.5]).double(), seed=0, **settings)
    assert (found.status, found.success) == ("solved", True)
    assert "jumps" not in found.message


@pytest.mark.parametrize("engine", ["descent", "gaussian_process"])
@pytest.mark.parametrize("beyond", [2.0, math.nan])
def test_a_better_point_of_a_round_that_goes_on_is_no_arrival(beyond, engine):
    """Beside a jump every round ends at another point of its edge. The last one has not ended."""

    def cut(z):
        return torch.where(z.sum(1) < 1.0, beyond, (z.square().sum(1) - 0.5) / 5.625)

    settings = {"sigma": 1.0, "bounds": (-4.0, 4.0), "engine": engine, "max_evaluations": 120, "target": 1e-3}
    found = zh.minimize(cut, torch.tensor([1.75, 1.75]).double(), seed=0, **settings)
    assert not found.success or found.value <= 1e-3


@pytest.mark.parametrize(
    ("fn", "n"),
    [
        (lambda z: -torch.exp(z.sum(1)), 1),
        (lambda z: -torch.exp(z.sum(1)), 8),
        (lambda z: -(z - 0.3).square().sum(1), 1),
        (lambda z: -(z - 0.3).square().sum(1), 8),
        (lambda z: -(z - 0.3).pow(4).sum(1), 2),
        (lambda z: -(1e5 * (z - 0.3).square() + torch.log(1 + z.abs())).sum(1), 8),
    ],
    ids=["exp", "exp of eight", "square", "square of eight", "fourth", "likelihood"],
)
def test_a_loss_that_falls_without_end_is_not_solved(fn, n):
    fit = zh.minimize(fn, zeros(n), sigma=0.5, seed=0)
    assert (fit.status, fit.success) == ("stalled", False)
    assert fit.message.startswith("the loss seems unbounded below")
    assert fit.evaluations < 250


@pytest.mark.parametrize("scale", [1e20, 1e120, 1e200])
def test_a_large_loss_that_has_a_minimum_is_solved(scale):
    fit = zh.minimize(lambda z: scale * ((z - 1000.0).square().sum(1) - 10.0), zeros(2), sigma=1.0, seed=0)
    assert fit.success
    assert float((fit.x - 1000.0).abs().max()) < 1e-3


@pytest.mark.parametrize(("bounds", "most"), [(None, 150), ((-3.0, 3.0), 100)])
def test_minus_infinity_beside_x_is_no_minimum(bounds, most):
    """Farther away it is avoided, and a minimum is one."""

    def fn(z, center=2.0):
        return torch.where(z[:, 0] > 1.0, -torch.inf, (z - center).square().sum(1))

    settings = {"sigma": 0.5, "seed": 0, "bounds": bounds, "max_evaluations": most}
    fit = zh.minimize(fn, zeros(1) + 0.2, **settings)
    assert not fit.success
    assert "the loss seems unbounded below, and x is no minimum: check its sign, or give bounds" in fit.message
    assert zh.minimize(lambda z: fn(z, -0.5), zeros(1) + 0.2, **settings).success


@pytest.mark.parametrize("bounds", [None, (-2.0, 2.0)])
def test_a_cusp_is_no_evidence_of_a_minimum(bounds):
    """Parameters that sit in a cusp shrink the region for all others, which are not at their minimum."""
    start = 2.0 * torch.rand(4, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1.0
    settings = {"sigma": 0.5, "bounds": bounds, "restarts": 0, "seed": 1}
    fit = zh.minimize(lambda z: (z - 0.3).abs().sqrt().sum(1), start, **settings)
    assert (fit.status, fit.success) == ("stalled", False)
    assert fit.message.endswith("which may be no minimum")
    assert zh.minimize(lambda z: (z - 0.3).abs().sum(1), start, **settings).success


def test_penalties_do_not_make_two_minima_the_same():
    """Most values are a penalty of 1e12. Minima of 0.995 and 0 are as different as without them."""

    def rastrigin(z):
        inside = 20.0 + (z.square() - 10.0 * (2 * math.pi * z).cos()).sum(1)
        return torch.where(z.abs().amax(1) < 1.6, inside, 1e12)

    fit = zh.minimize(rastrigin, [0.9, 0.9], sigma=1.0, bounds=(-8, 8), seed=1, max_evaluations=120)
    assert "not unique" not in fit.message


def test_the_border_of_a_region_that_fails_is_no_minimum_that_rounds_confirm():
    """The lowest point of the border is (0.6, 0.6). The loss goes on falling along the border from other points."""

    def f(x):
        return math.nan if float(x.sum()) > 1.2 else float((x - 1.0).square().sum())

    fit = zh.minimize(f, zeros(2), sigma=0.5, max_evaluations=250, vectorized=False, seed=3)
    assert fit.status == "budget"
    assert "fails next to x" in fit.message


@pytest.mark.parametrize("seed", [4, 9])
def test_before_a_wall_of_failures_nothing_is_solved(seed):
    """The loss falls towards the wall, and the last steps are too long for failures within 0.02 sigma."""
    wanted = torch.tensor([0.3, -0.5, 0.1, 1.3]).double()

    def fn(x):
        y = torch.stack([x[0], x[1], x[0] ** 2, x[1] ** 2 - x[0] + 1.35])
        return y if x[0] >= 0.5 else y * math.nan

    settings = {"loss": lambda y: (y - wanted).square().sum(), "vectorized": False, "restarts": 0, "seed": seed}
    found = zh.minimize(fn, [1.0, 2.0], sigma=1.0, **settings)
    assert (found.status, found.success) == ("stalled", False)
    assert "fails next to x" in found.message


@pytest.mark.parametrize("loss", [None, lambda y: y.square().sum()])
def test_every_engine_says_that_a_minimum_may_not_be_unique(loss):
    """a b exp(-c t) determines the product of a and b alone."""
    t = torch.linspace(0, 5, 30).double()

    def missed(p):
        y = p[:, :1] * p[:, 1:2] * torch.exp(-p[:, 2:] * t) - 6.0 * torch.exp(-0.5 * t)
        return y.square().sum(1) if loss is None else y

    def said(seed, **settings):
        found = zh.minimize(missed, [1.0, 1.0, 1.0], sigma=1.0, loss=loss, seed=seed, **settings)
        assert found.success
        return found.message

    box = {"bounds": ([0.1] * 3, [8, 8, 3]), "restarts": 0}
    maybe = "along some direction the loss hardly changes: the minimum may not be unique"
    assert sum(said(seed, **box).endswith(maybe) for seed in range(2, 5)) >= 2  # others have evaluated too little
    assert said(0).endswith("the minimum is not unique")
