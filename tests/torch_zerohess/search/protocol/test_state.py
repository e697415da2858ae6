"""The state of every search: saved, loaded and told late, it changes nothing."""

import random
from dataclasses import replace

import pytest
import torch
from every_search import black_box, every_search, make, same, saved
from searches import bowl, points_of, rosenbrock, run, zeros

from torch_zerohess.optim import (
    Descent,
    TrustRegion,
)
from torch_zerohess.search.protocol.state import Arrivals, Best, Evaluated, Progress
from truths import vector


@every_search
def test_it_resumes_bit_by_bit_at_every_step(name):
    """In 25 steps, and until the first round has ended."""
    search, f = make(name, seed=3, tolerance=0.2), black_box(name)
    steps = 0
    while steps < 25 or search.rounds == 0:
        steps += 1
        assert steps <= 120
        copy = make(name, seed=99, tolerance=0.2)
        copy.load_state_dict(saved(search.state_dict()))
        assert same(copy.state_dict(), search.state_dict())
        points = search.ask()
        assert torch.equal(copy.ask(), points)
        values = f(points)
        search.tell(values)
        copy.tell(values)
        assert same(copy.state_dict(), search.state_dict())
        assert torch.equal(copy.x, search.x)
        assert torch.equal(copy.center, search.center)
        for number in ("value", "sigma", "evaluations", "iterations", "rounds", "done", "message"):
            assert getattr(copy, number) == getattr(search, number)


def test_points_may_be_evaluated_before_the_search_is_loaded():
    search, copy = make("process of the loss"), make("process of the loss")
    points = search.ask()
    copy.load_state_dict(search.state_dict())
    copy.tell(rosenbrock(points))
    search.tell(rosenbrock(points))
    assert same(copy.state_dict(), search.state_dict())


@every_search
def test_values_told_late_and_out_of_order_change_nothing(name):
    """One point at a time, in any order, saved and loaded in between: the states of one that is told all at once."""
    search, late, f = make(name, seed=3), make(name, seed=3), black_box(name)
    chance = random.Random(0)
    for _ in range(8):
        points = search.ask()
        values = f(points)
        assert torch.equal(late.ask(), points)
        before = late.state_dict()
        for k in chance.sample(range(len(points)), len(points)):
            assert late.missing == [one for one in range(len(points)) if one not in late.state_dict()["early"]]
            late.tell(values[[k]], which=[k])
            if k % 3 == 0:
                state = saved(late.state_dict())
                late = make(name, seed=99)
                late.load_state_dict(state)
        assert len(points) == 1 or not same(late.state_dict(), before)
        search.tell(values)
        assert same(late.state_dict(), search.state_dict())


def test_values_of_some_points_are_checked():
    search = Descent(zeros(5), sigma=1.0, seed=0)
    values = bowl(search.ask())
    search.tell(values[[4, 1]], which=[4, 1])
    assert search.missing == [0, 2, 3, 5]
    for which, one, message in [
        ([1], values[[1]], r"which must be some of the points whose values are missing, \[0, 2, 3, 5\], got \[1\]"),
        ([6], values[[0]], r"are missing, \[0, 2, 3, 5\], got \[6\]"),
        ([0, 0], values[[0, 0]], r"are missing, \[0, 2, 3, 5\], got \[0, 0\]"),
        ([0, 2], values[[0]], r"values must have one per point in which, \[2, \*out\], got \[1\]"),
        ([0], values[None, :2], r"values must have outputs \[\] as before, got \[2\]"),
    ]:
        with pytest.raises(ValueError, match=message):
            search.tell(one, which=which)
    assert search.missing == [0, 2, 3, 5]
    search.ask(limit=3)  # the others are given up
    search.tell(values[[0, 2]])  # all that are missing
    assert (search.evaluations, search.missing) == (3, [])


def test_a_state_is_not_changed_by_the_search_it_came_from():
    name = "descent of the output"
    search, f = run(make(name), black_box(name), 30), black_box(name)
    state = search.state_dict()
    first = points_of(search, f, 80)
    copy = make(name, seed=1)
    for _ in range(2):
        copy.load_state_dict(state)
        assert torch.equal(points_of(copy, f, 80), first)


def test_losses_told_before_a_state_is_loaded_are_not_those_told_last():
    search = Descent(zeros(2), sigma=1.0, seed=0)
    state = search.state_dict()
    search.tell(bowl(search.ask()))
    assert len(search.told) == 3
    search.load_state_dict(state)
    assert search.told.tolist() == []


def test_the_settings_stay_those_of_the_search_that_loads():
    search = run(Descent(zeros(2), sigma=1.0, noise=1e-3, pool=60, seed=0), bowl, 40)
    copy = Descent(zeros(2), sigma=1.0, noise=1e-3, pool=5, seed=0)
    copy.load_state_dict(search.state_dict())
    copy.tell(bowl(copy.ask()))
    assert len(copy.state_dict()["progress"]["values"]) == 5


def test_a_state_in_noise_is_of_another_search():
    state = Descent(zeros(2), sigma=1.0, noise=0.1, seed=0).state_dict()
    with pytest.raises(
        ValueError, match="must be of a search by descent of the loss, got one by descent of the loss in"
    ):
        Descent(zeros(2), sigma=1.0, seed=0).load_state_dict(state)


def test_rounds_agree_that_arrive_at_one_point_which_is_the_best_one():
    """Within 0.05 of each parameter, root mean square."""
    first = Progress(best=Best(vector(1.0, 0.0)), center=zeros(2)).agreeing(Best(vector(1.0, 0.0)), 0.05)
    second = first.agreeing(Best(vector(1.07, 0.0)), 0.05)
    assert (first.agreed, second.agreed, second.arrivals.apart) == (1, 2, False)
    assert second.agreeing(Best(vector(1.08, 0.0)), 0.05).agreed == 0
    second = replace(second, best=Best(vector(3.0, 0.0))).with_arrivals(higher=2)
    moved = second.agreeing(Best(vector(3.0, 0.0)), 0.05)
    assert (moved.agreed, moved.arrivals.higher) == (1, 0)
    assert (moved.agreed, moved.arrivals.place.point.tolist()) == (1, [3.0, 0.0])


def test_rounds_agree_that_arrive_at_one_loss():
    """Equal within 1e-4 of the distance of the lower quartile, 6, from the lowest loss, 1: 5e-4."""
    losses, tolerance = vector(1.0, 6.0, 1e9, 1e12, 1e12), 0.05
    begun = Progress(best=Best(vector(0.0), 1.0), center=zeros(1))
    first = begun.agreeing(Best(vector(0.0), 1.0), tolerance, losses)
    second = first.agreeing(Best(vector(3.0), 1.0 + 4e-4), tolerance, losses)
    assert (second.agreed, second.arrivals.apart) == (2, True)
    assert second.agreeing(Best(vector(0.0), 1.0), tolerance, losses).agreed == 3
    assert first.agreeing(Best(vector(3.0), 1.0 + 6e-4), tolerance, losses).agreed == 0
    assert first.agreeing(Best(vector(3.0), 1.0 + 4e-4), tolerance).agreed == 0
    lower = replace(second, best=Best(vector(5.0), 0.0))
    after = lower.agreeing(Best(vector(5.0), 0.0), tolerance, losses)
    assert (after.agreed, after.arrivals.apart) == (1, False)
    # A round elsewhere comes between: the first round after it counts like all others.
    broken = second.agreeing(Best(vector(8.0), 9.0), tolerance, losses)
    again = broken.agreeing(Best(vector(3.0), 1.0 + 4e-4), tolerance, losses)
    again = again.agreeing(Best(vector(0.0), 1.0), tolerance, losses)
    assert (broken.agreed, again.agreed, again.arrivals.apart) == (0, 2, True)


def test_an_output_that_is_not_finite_is_no_value_whatever_its_loss():
    outputs = torch.tensor([[1.0, torch.nan], [1.0, 2.0], [1.0, 2.0]])
    assert Evaluated(zeros(3)[:, None], vector(1.0, 1.0, torch.inf), outputs).finite.tolist() == [False, True, False]


@pytest.mark.parametrize(
    ("n", "changes", "message"),
    [
        (3, {}, "2 parameters, got one with 3"),
        (2, {"sigma": 2.0}, r"sigma = \[1.0, 1.0\], got \[2.0, 2.0\]"),
        (2, {"bounds": (-5.0, 5.0)}, "by descent of the loss, got one by gaussian_process of the loss"),
        (2, {"loss": torch.sum}, "by descent of the loss, got one by descent of the output"),
        (2, {"bounds": (-9.0, None)}, r"lower bounds \[-inf, -inf\], got \[-9.0, -9.0\]"),
    ],
)
def test_a_state_of_another_search(n, changes, message):
    search, other = TrustRegion(zeros(2), sigma=1.0, seed=0), TrustRegion(zeros(n), **{"sigma": 1.0, **changes})
    asked = search.ask()
    with pytest.raises(ValueError, match=message):
        search.load_state_dict(other.state_dict())
    assert torch.equal(search.ask(), asked)


@pytest.mark.parametrize(
    ("best", "rounds", "expected"),
    [
        (Best(vector(1.0, 1.0), 2.0), 1, True),
        (Best(vector(1.0, 1.0), 2.0), 0, False),  # the round goes on
        (Best(vector(1.0, 1.0 + 1e-5), 1.9), 1, True),
        (Best(vector(3.0, 1.0), 1.9), 1, False),  # lower, and elsewhere
        (Best(vector(1.0, 1.0), 2.1), 1, False),
    ],
)
def test_a_search_is_at_an_arrival_where_its_best_point_is_one(best, rounds, expected):
    arrivals = Arrivals(rounds=rounds, lowest=Best(vector(1.0, 1.0), 2.0))
    assert Progress(best=best, center=best.point, arrivals=arrivals).is_at_arrival(1e-3) is expected


def test_an_arrival_is_polished_if_the_lowest_one_is():
    first, lower = Best(vector(0.0), 2.0), Best(vector(1.0), 1.0)
    rough = Progress(best=first, center=first.point).arriving(first, polished=False)
    assert not rough.arrivals.polished
    assert rough.arriving(first).arrivals.polished
    assert rough.arriving(lower).arrivals.polished
    assert not rough.arriving(Best(lower.point, 3.0)).arrivals.polished
    assert not rough.arriving(first).arriving(lower, polished=False).arrivals.polished
    assert rough.arriving(first).arriving(first, polished=False).arrivals.polished
