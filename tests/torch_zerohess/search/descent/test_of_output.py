"""Descent on an output: when Gauss-Newton takes over, what that gains, and when the descent follows again."""

import pytest
import torch
from every_search import same, saved
from searches import Linear, bent, plateau, rays, rays_loss, run, zeros

import torch_zerohess as zh
from torch_zerohess.optim import Descent
from torch_zerohess.search.descent import of_output
from torch_zerohess.search.gauss_newton import by_interpolation
from torch_zerohess.search.gauss_newton.by_interpolation import OutputGaussNewton
from truths import vector


def squares(y):
    return y.square().sum()


def evaluations(search, f, level, most=1000):
    while search.value > level and not search.done and search.evaluations < most:
        search.tell(f(search.ask()))
    return search.evaluations if search.value <= level else most


def smooth(search):
    return search.state_dict()["progress"]["smooth"] is not None


@pytest.mark.parametrize("seed", range(6, 8))
@pytest.mark.parametrize(("n", "most"), [(4, 60), (8, 110)])
def test_it_converges_fast_where_residuals_are_not_zero(n, most, seed, monkeypatch):
    def search():
        return Descent(torch.full((n,), 2.0, dtype=torch.float64), sigma=0.5, loss=squares, seed=seed, restarts=0)

    assert evaluations(search(), bent, 1 + 1e-8) < most
    monkeypatch.setattr(of_output, "_PREDICTED", 0.0)
    monkeypatch.setattr(of_output, "MOST", 0)
    assert evaluations(search(), bent, 1 + 1e-8) > 2 * most


TIMES = torch.linspace(0.0, 3.0, 20, dtype=torch.float64)
DECAY = vector(1.5, 2.0, 0.5)
KINKED = {  # target, loss, and its least value, all at DECAY
    # Of 20 outputs three are wrong: the sum of distances ignores them.
    "sum of distances": (1.0 * torch.isin(torch.arange(20), torch.tensor([3, 9, 16])), lambda d: d.abs().sum(), 3.0),
    # The error alternates more often than there are parameters: no decay is nearer.
    "largest distance": (0.05 * (-1.0) ** torch.arange(20), lambda d: d.abs().max(), 0.05),
    "norm": (torch.zeros(20), lambda d: d.norm(), 0.0),
}


def decays(x):
    return x[:, :1] * torch.exp(-x[:, 1:2] * TIMES) + x[:, 2:]


@pytest.mark.parametrize("name", KINKED)
@pytest.mark.parametrize("bounds", [None, (vector(0.0, 0.0, -1.0), vector(4.0, 4.0, 2.0))])
def test_a_loss_may_have_kinks(name, bounds, monkeypatch):
    """With quadratics of the loss alone a sum of distances is not there after three times as many evaluations."""
    wrong, distance, least = KINKED[name]
    target = decays(DECAY[None])[0] + wrong

    def search(seed):
        return Descent(
            vector(0.5, 1.0, 0.0), sigma=0.5, loss=lambda y: distance(y - target), bounds=bounds, seed=seed, restarts=0
        )

    assert max(evaluations(search(seed), decays, least + 1e-6) for seed in range(2)) < 100
    if bounds is None and name == "sum of distances":
        monkeypatch.setattr(by_interpolation, "holds", lambda *_: True)
        assert evaluations(search(0), decays, least + 1e-6, 301) > 300


@pytest.mark.parametrize("seed", range(3))
def test_at_a_kink_the_step_is_the_best_one_in_the_region(seed, monkeypatch):
    """Linear outputs: the first step is as low as the lowest point on a circle around the best of the first points.

    The minimum is 10 regions away, in another direction.
    """

    def outputs(x):
        return torch.stack([10.0 * x[:, 0] + x[:, 1] - 5.0, x[:, 1] - 10.0], 1)

    def ratio():
        search = Descent(zeros(2), sigma=1.0, loss=lambda y: y.abs().sum(), seed=seed)
        search.tell(outputs(search.ask()))
        center, before = search.x, search.value
        angle = torch.linspace(0.0, 2.0 * torch.pi, 3601, dtype=torch.float64)
        circle = center + torch.stack([angle.cos(), angle.sin()], 1)
        least = float(outputs(circle).abs().sum(1).min())
        search.tell(outputs(search.ask()))
        return (before - search.value) / (before - least)

    assert ratio() > 0.99
    monkeypatch.setattr(by_interpolation, "_STEEP", 0.0)
    assert ratio() < 0.95


@pytest.mark.parametrize(("n", "seed", "kind"), [(8, 0, "largest"), (8, 5, "mean"), (12, 2, "mean")])
def test_at_kinks_on_the_sides_of_a_box_it_arrives_at_the_minimum(n, seed, kind):
    """Kinks and sides meet at the minimum: there a slope may point to no decrease although there is one."""
    fn = Linear(n, seed, kind)
    search = run(Descent(zeros(n), sigma=1.0, bounds=(-1, 1), loss=fn.loss, seed=seed, restarts=0), fn, 300)
    assert search.solved
    assert fn.excess(search.value) < 1e-6


def test_rounded_outputs_do_not_keep_it_from_arriving(monkeypatch):
    """Residuals that are not zero, rounded to 1e-8 as by an adaptive solver: short steps promise what is not there.

    Three in five of the searches arrive within 100 evaluations: with the others, short steps promise too much. Which
    ones these are depends on the last bits of the machine's linear algebra.
    """

    def found(seed):
        search = Descent(torch.full((4,), 2.0, dtype=torch.float64), sigma=0.5, loss=squares, seed=seed, restarts=0)
        return run(search, lambda x: torch.round(1e8 * bent(x)) / 1e8, 300)

    searches = [found(seed) for seed in range(50, 60)]
    assert all(one.value == pytest.approx(1.0, abs=1e-8) for one in searches)
    assert sum(one.done and one.evaluations < 100 for one in searches) >= 4
    monkeypatch.setattr(by_interpolation, "NOTHING", 0.0)
    taken = sum(one.evaluations for one in searches[:3])
    assert sum(found(seed).evaluations for seed in range(50, 53)) > 1.5 * taken


@pytest.mark.parametrize("bend", [0.0, 1e-6])
def test_where_outputs_are_linear_it_arrives_soon_after_the_minimum(bend):
    """Ten parameters: a Jacobian takes 11 evaluations. The squares are least, and not zero, at a known point.

    In regions far below the tolerance roundings of the outputs would promise steps, and all of them would be refused.
    """
    generator = torch.Generator().manual_seed(0)
    A, errors = (torch.randn(21, k, generator=generator, dtype=torch.float64) for k in (10, 1))
    errors = errors - A @ torch.linalg.lstsq(A, errors).solution  # orthogonal to what parameters change
    target = 0.3 * A.sum(1) + errors[:, 0]

    def outputs(x):
        straight = x @ A.mT - target
        return straight + bend * straight.square()

    for seed in range(4):
        search = run(Descent(zeros(10), sigma=0.3, loss=squares, seed=seed, restarts=0), outputs, 200)
        assert search.solved
        assert search.evaluations < 30
        assert (search.x - 0.3).abs().max() < 1e-4


def test_the_hessian_of_an_output_is_not_damped():
    """J^T J has curvatures of 2 to 8e-4. A thousandth of their mean would double the smallest one, as a step may."""
    scale = vector(1.0, 0.3, 0.1, 0.02)
    search = run(Descent(zeros(4), sigma=1.0, loss=squares, seed=0, restarts=0), lambda x: scale * x - 1.0, 60)
    model, sigma = search.model_at_best()
    found = torch.linalg.eigvalsh(model.full_hessian() / sigma**2)
    torch.testing.assert_close(found, (2.0 * scale.square()).sort().values, rtol=1e-2, atol=0.0)


def test_it_promises_what_gauss_newton_promises_in_its_turn():
    def nearly_affine(x):
        return torch.cat([bent(x)[:, :-1], (0.01 * x).tanh()], 1)

    search = Descent(torch.full((5,), 2.0, dtype=torch.float64), sigma=0.5, loss=squares, seed=0)
    while not (smooth(search) and search.promise < float("inf")):
        search.tell(nearly_affine(search.ask()))
    assert search.promise == pytest.approx(search.value, rel=0.1)  # the least loss is 0


def test_a_step_that_was_predicted_is_the_evidence():
    search, before = Descent(zeros(5), sigma=1.0, loss=rays_loss(5), seed=0, restarts=0), None
    while not smooth(search):
        before = search.value
        search.tell(rays(search.ask()))
    assert search.value < before
    assert len(search.ask()) == 1
    assert search.evaluations <= 20


@pytest.mark.parametrize(("n", "noise"), [(3, 0.1), (41, 0.0)])
def test_in_noise_and_in_many_dimensions_it_only_follows(n, noise):
    search = Descent(zeros(n), sigma=1.0, loss=squares, noise=noise, seed=0, restarts=0)
    for _ in range(20):
        search.tell(search.ask() - 1.0)
        assert search.done or not smooth(search)


def test_where_the_output_has_steps_the_descent_follows_again():
    """Outputs in steps of 1/2: their slope is told far from the minimum, and is zero or infinite nearby."""
    search, seen = Descent(zeros(4), sigma=1.0, loss=squares, seed=1), []
    while search.evaluations < 200:
        points = search.ask()
        search.tell(torch.round(2 * (points + 0.2 * points.sum(1, keepdim=True) - 7.1)) / 2)
        seen.append(smooth(search))
    assert True in seen
    assert seen[seen.index(True) :].count(False) > 5
    assert search.value < 0.5  # of 200


def test_after_five_rejected_steps_gauss_newton_has_failed():
    """Outputs with ripples: their slope is told far from the minimum, and is another one at every point nearby."""

    def rippled(points):
        linear = points + 0.2 * points.sum(1, keepdim=True) - 7.1
        return linear + 0.1 * torch.sin(40 * linear)

    failed = []
    for seed in range(4):
        search = Descent(zeros(4), sigma=1.0, loss=squares, seed=seed, restarts=0)
        while not search.done and search.evaluations < 100:
            before = search.state_dict()["progress"]["smooth"]
            search.tell(rippled(search.ask()))
            if before is not None and not smooth(search) and not search.done:
                failed.append(before["rejected"] + 1)
    assert len(failed) >= 2
    assert set(failed) == {5}


def test_gauss_newton_begins_with_a_region_as_wide_as_its_evaluations_lie(monkeypatch):
    """The minimum is next to the start. Where the first step ends there, it is short: one in four of these searches."""
    scales = vector(1.0, 100.0, 100.0, 100.0)

    def first_region(seed):
        found, begin = [], OutputGaussNewton.taking_over
        with monkeypatch.context() as patch:
            patch.setattr(OutputGaussNewton, "taking_over", lambda *given: found.append(given[4]) or begin(*given))
            search = Descent(torch.full((4,), 1e-3, dtype=torch.float64), sigma=1.0, loss=squares, seed=seed)
            while not found:
                search.tell(search.ask() * scales)
        return found[0]

    assert min(first_region(seed) for seed in range(10)) > 0.05
    monkeypatch.setattr(of_output, "_LEAST", 0.0)
    assert min(first_region(seed) for seed in range(10)) < 0.01


def test_on_a_plateau_it_never_begins():
    search = Descent(vector(2.0, 1.0), sigma=1.5, loss=torch.sum, seed=0)
    assert smooth(search)  # with two parameters it begins so
    run(search, lambda z: torch.zeros(len(z), 1, dtype=torch.float64), 3)
    assert not smooth(search)
    run(search, lambda z: plateau(z)[:, None], 150)
    assert search.value < -0.9


def test_an_arrival_is_one_of_the_round():
    search = Descent(torch.full((3,), 2.0).double(), sigma=0.5, loss=squares, seed=0, restarts=2)
    run(search, bent, 2000)
    assert search.done
    assert search.solved
    assert search.rounds == 3
    assert search.value == pytest.approx(1.0, abs=1e-12)


def test_it_goes_on_bit_by_bit_from_a_state_of_gauss_newton():
    search, again = (Descent(zeros(5) - 1, sigma=0.5, loss=squares, seed=3) for _ in range(2))
    while not smooth(search):
        search.tell(bent(search.ask()))
    for batch in (1, 1, 4, 1, 4, 1):
        again.load_state_dict(saved(search.state_dict()))
        assert torch.equal(search.ask(batch), again.ask(batch))
        for one in (search, again):
            one.tell(bent(one.ask(batch)))
        assert same(search.state_dict(), again.state_dict())


def test_its_model_at_the_best_point_is_that_of_the_output():
    search = Descent(zeros(3) + 1, sigma=0.5, loss=squares, seed=0, restarts=0)
    evaluations(search, bent, 1 + 1e-9)
    assert smooth(search)
    model, sigma = search.model_at_best()
    jacobian = torch.func.jacrev(lambda x: bent(x[None])[0])(search.x)
    width = sigma * float(search.unit[0])
    curvature = 2 * width**2 * jacobian.mT @ jacobian
    error = (model.full_hessian() - curvature).norm() / curvature.norm()
    assert float(error) < 0.05


def bent_but_for(low, high):
    """`bent` with a hole where the first parameter is between low and high."""
    return lambda x: torch.where((x[:, :1] > low) & (x[:, :1] < high), torch.nan, bent(x))


def from_afar():
    return Descent(torch.full((4,), 2.0, dtype=torch.float64), sigma=0.5, loss=squares, seed=0, restarts=0)


def test_with_little_memory_every_output_stays_with_its_point():
    """The best point stays, however old it is; four more points are the latest ones."""
    search = Descent(zeros(2), sigma=1.0, loss=squares, seed=0, pool=5)
    for _ in range(4):
        search.tell(bent(search.ask(8) + 3.0))
        known = search.state_dict()["progress"]["smooth"]
        assert len(known["points"]) == 5
        assert torch.equal(known["outputs"], bent(known["points"] + 3.0))
        assert bool((known["points"] == known["lowest"]["point"]).all(1).any())


def test_holes_do_not_shift_the_outputs():
    """Values that are not finite are left out with their points."""
    search, holes, met = from_afar(), bent_but_for(0.1, 0.3), 0
    while search.value > 1.06:
        values = holes(search.ask())
        met += smooth(search) and int(values.isnan().any(1).sum())
        search.tell(values)
        if smooth(search):
            told = search.state_dict()["progress"]["smooth"]
            losses = told["outputs"].square().sum(1)
            torch.testing.assert_close(losses, told["values"])
    assert met > 1


def test_before_a_wall_gauss_newton_fails():
    """The descent finds the way around: with one method alone every step goes into the wall."""
    assert evaluations(from_afar(), bent_but_for(1.0, 1.6), 1.1) < 100


@pytest.mark.parametrize("restarts", [0, None])
def test_outputs_in_units_that_differ_by_a_million(restarts):
    """Each curvature is the square of an output's unit: a step that takes small ones for zero goes nowhere."""

    def outputs(z):
        return torch.stack([1e6 * (z[:, 0] + z[:, 1] - 1.0), z[:, 0] - z[:, 1] + 0.2, 1e-3 * (z[:, 2] - 100.0)], 1)

    settings = {"sigma": [1.0, 1.0, 100.0], "seed": 0, "restarts": restarts, "max_evaluations": 100}
    found = zh.minimize(outputs, [0.0, 0.0, 0.0], loss=lambda y: y.square().mean(), **settings)
    assert found.success
    torch.testing.assert_close(found.x.double(), vector(0.4, 0.6, 100.0), rtol=1e-5, atol=1e-6)
