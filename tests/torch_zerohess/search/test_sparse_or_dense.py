"""The choice between a sparse and a dense Jacobian: by evidence, and made again while evaluations double."""

import pytest
import torch
from searches import SIDE, N, run, square
from searches import texels as image

import torch_zerohess as zh
from torch_zerohess.optim import Descent, TrustRegion
from truths import normal


def door(n, loss, **settings):
    return TrustRegion(torch.zeros(n).double(), sigma=1.0, loss=loss, seed=3, **settings)


def test_a_sparse_jacobian_is_chosen_by_evidence():
    search = door(N, square(image(normal(1, N))[0]))
    assert search.engine == "descent"
    assert "are to show" in search.reason
    run(search, image, 39)
    assert search.engine == "local"
    assert "100% of the change of held-out outputs, a dense one" in search.reason
    assert search.value < 1e-4
    again = door(N, square(image(normal(1, N))[0]))
    again.load_state_dict(search.state_dict())
    assert again.engine == "local"
    assert torch.equal(again.ask(), search.ask())


def test_the_caller_may_use_the_memory_of_outputs_again():
    """The first samples tell too little: the search keeps them, and chooses with those of the second part."""
    A, b, values = normal(150, 40), normal(150, seed=1), []
    for reuses in (False, True):
        search = door(40, square(b))
        while search.evaluations < 60:
            outputs = search.ask() @ A.mT
            search.tell(outputs)
            if reuses:
                outputs.zero_()
        values.append((search.value, search.x.tolist()))
    assert values[0] == values[1]


@pytest.mark.parametrize(("noise", "asked"), [(0.5, 6), (1.0, 32)])
def test_where_the_first_samples_predict_less_than_half_the_rest_is_asked_for(noise, asked):
    """Otherwise the next points are steps. A perfect fit would predict 1 / (1 + noise^2) of the change."""
    search, generator = door(N, square(0.0)), torch.Generator().manual_seed(0)
    points = search.ask()
    search.tell(image(points) + noise * torch.randn(33, SIDE, SIDE, generator=generator, dtype=torch.float64))
    assert len(search.ask()) == asked


@pytest.mark.parametrize("n", [20, 100])
def test_a_dense_jacobian_costs_no_evaluation_more_than_before(n):
    """The points equal the points of `Descent`, to the last bit."""
    A, b = normal(150, n), normal(150, seed=1)
    search, descent = (
        door(n, square(b)),
        Descent(torch.zeros(n).double(), sigma=1.0, loss=square(b), seed=3),
    )
    points = [[], []]
    for one, seen in zip((search, descent), points, strict=True):
        while one.evaluations < n + 20 and not one.done:
            z = one.ask(limit=n + 20 - one.evaluations)
            seen.append(z)
            one.tell((z[:, None] * A).sum(2))  # the same bits in every batch
    assert search.engine == "descent"
    assert "a sparse Jacobian predicts" in search.reason
    assert torch.equal(torch.cat(points[0]), torch.cat(points[1]))


def mean_of(z, reach):
    """Every parameter and the mean of its neighbours, overlapping footprints."""
    return sum(z.roll(k, 1) for k in range(-reach, reach + 1)) / (2 * reach + 1)


@pytest.mark.parametrize(
    "f", [lambda z: torch.tanh(torch.cat([z, mean_of(z, 1)], 1)), lambda z: mean_of(z, 2) + 0.3 * z]
)
def test_where_a_batch_determines_the_dense_jacobian_a_poor_sparse_one_is_not_taken(f):
    """A part of the batch predicts nothing by a dense Jacobian, which all of it determines."""
    for seed in range(3):
        loss = square(f(torch.rand(1, 20, generator=torch.Generator().manual_seed(seed)).double())[0])
        counts = []
        for engine in ("auto", "descent"):
            search = TrustRegion(torch.zeros(20).double(), sigma=1.0, loss=loss, seed=3, engine=engine)
            first = float(loss(f(search.x[None])[0]))
            counts.append(run(search, f, 100, 0.01 * first).evaluations)
        assert counts[0] <= 1.2 * counts[1]


def mixed(n):
    """A [2 n, n]: each output is a parameter and, beside it, a map of rank 5."""
    return torch.eye(n).double().repeat(2, 1) + 0.13 * normal(2 * n, 5, seed=1) @ normal(5, n, seed=2) / 5**0.5


def engines(search, f, value, evaluations):
    """The engine after each batch, until the value is reached."""
    seen = []
    while search.value > value and search.evaluations < evaluations and not search.done:
        search.tell(f(search.ask()))
        seen.append(search.engine)
    return seen


def test_a_dense_part_beside_a_sparse_one_is_noticed():
    """The first samples determine the one parameter of each output, and little else."""
    n = 100
    A = mixed(n)
    search = door(n, square(A @ normal(n)))
    seen = engines(search, lambda x: x @ A.mT, 1e-4, 2 * n)
    assert "local" in seen
    assert search.engine == "descent"
    assert search.value <= 1e-4


def blurred(x):
    """Each of three channels is blurred over 3x3 pixels: [K, n] -> [K, 16, 16, 3]."""
    channels = x.view(-1, 16, 16, 3).permute(0, 3, 1, 2)
    return torch.nn.functional.avg_pool2d(channels, 3, 1, 1).permute(0, 2, 3, 1)


def test_a_support_that_the_first_samples_do_not_tell_is_found_by_more():
    """Nine texels per pixel, in an order that does not show which ones are neighbours."""
    n = 3 * 16**2
    order = torch.randperm(n, generator=torch.Generator().manual_seed(0))
    loss = square(blurred(normal(1, n)[:, order])[0])
    search = door(n, loss)
    least = 1e-3 * float(loss(blurred(torch.zeros(1, n).double())[0]))
    seen = engines(search, lambda x: blurred(x[:, order]), least, n // 2)
    assert seen[2] == "descent"
    assert search.engine == "local"
    assert search.evaluations < n // 2


def test_neighbours_are_found_by_the_first_samples():
    """The same image with its texels in order: the first batch tells that they lie on a grid of 16x16x3."""
    n = 3 * 16**2
    loss = square(blurred(normal(1, n))[0])
    search = door(n, loss)
    seen = engines(search, blurred, 1e-3 * float(loss(blurred(torch.zeros(1, n).double())[0])), n // 2)
    assert seen[1] == "local"


@pytest.mark.parametrize("dead", [0, 20])
def test_the_value_is_one_of_the_best_point_also_after_a_change(dead):
    """The start is not the best point when the search changes; the last parameters have no effect."""
    n = 3 * 16**2

    def some(x):
        return blurred(x[:, :n])

    loss = square(some(1.0 + normal(1, n))[0])
    search = door(n + dead, loss)
    engines_seen = set()
    while search.evaluations < 200 and not search.done:
        search.tell(some(search.ask()))
        engines_seen.add(search.engine)
        assert search.value == pytest.approx(float(loss(some(search.x[None])[0])), rel=1e-9)
    assert engines_seen == {"descent", "local"}


def test_the_best_point_counts_after_a_change_where_parameters_have_no_effect():
    """They lie where the descent has left them, not at the start. The call that Ctrl-C ends is not counted."""
    n, counts = 3 * 16**2, []

    def some(x):
        counts.append(len(x))
        if sum(counts) > 280:
            raise KeyboardInterrupt
        return blurred(x[:, :n])

    loss = square(blurred(1.0 + normal(1, n))[0])
    fit = zh.minimize(some, torch.zeros(n + 20).double(), sigma=1.0, loss=loss, max_evaluations=300, seed=3)
    assert fit.engine == "local"
    assert fit.value == pytest.approx(float(loss(blurred(fit.x[None, :n])[0])), rel=1e-9)
    assert fit.value < 0.1 * float(loss(blurred(torch.zeros(1, n).double())[0]))


def test_a_state_before_the_second_choice_goes_on_as_before():
    n = 100
    A = mixed(n)
    one, other = door(n, square(A @ normal(n))), door(n, square(A @ normal(n)))
    engines(one, lambda x: x @ A.mT, 0.0, 60)
    assert one.engine == "local"
    other.load_state_dict(one.state_dict())
    while one.evaluations < 140:
        points = one.ask()
        assert torch.equal(other.ask(), points)
        one.tell(points @ A.mT)
        other.tell(points @ A.mT)
    assert one.engine == other.engine == "descent"


def test_the_choice_is_final_where_too_much_would_be_kept(monkeypatch):
    """After the first batch these are 33 to 65 points of 100 parameters and 200 outputs."""
    monkeypatch.setattr("torch_zerohess.search.sparse_or_dense._HELD", 33 * 300 - 1)
    A = mixed(100)
    search = door(100, square(A @ normal(100)))
    engines(search, lambda x: x @ A.mT, 0.0, 100)
    known = search.state_dict()["progress"]
    assert (known["chosen"], known["due"], len(known["points"])) == ("local", 0, 0)


def test_the_evaluations_are_forgotten_once_the_choice_is_final():
    for f, n in ((image, N), (lambda x: (x[:, None] * normal(60, 30)).sum(2), 30)):
        search = door(n, square(f(normal(1, n))[0]))
        while search.evaluations < 4 * n and not search.done:
            search.tell(f(search.ask()))
        known = search.state_dict()["progress"]
        assert (known["due"], len(known["points"]), len(known["outputs"])) == (0, 0, 0)
