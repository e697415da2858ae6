"""Pool weights against the balance heuristic, and what a pool forgets."""

import math

import pytest
import torch

from torch_zerohess.surrogates.pool import Pool, covering
from truths import vector


def normal(generator, *shape):
    return torch.randn(*shape, dtype=torch.float64, generator=generator)


def filled_pool(n, batches=3):
    """A pool, and the batches it was filled with: points, values, centre, sigma."""
    generator = torch.Generator().manual_seed(n)
    pool, drawn = Pool.empty(n), []
    for k in range(batches):
        center, sigma = normal(generator, n), 0.5 + 0.4 * k
        points = center + sigma * normal(generator, 4 + k, n)
        drawn.append((points, points.sum(1), center, sigma))
        pool = pool.add(points, points.sum(1), None, center, sigma)
    return pool, drawn


@pytest.mark.parametrize("n", [1, 2, 3, 4, 6, 8])
def test_weights_are_the_balance_heuristic(n):
    """Density of N(x, sigma^2) over the mixture of what was drawn, in proportion to how many, to the power
    min(1, 4/n); at most 7.4.
    """
    pool, drawn = filled_pool(n)

    def density(z, center, width):
        return math.exp(-0.5 * float((z - center).square().sum()) / width**2) / (width * math.sqrt(2 * math.pi)) ** n

    total = sum(len(points) for points, *_ in drawn)
    for sigma in (0.8, 0.2):
        x = drawn[0][0][0] + 0.1 * sigma
        ratios = [
            density(z, x, sigma) / sum(len(p) / total * density(z, c, s) for p, _, c, s in drawn)
            for points, *_ in drawn
            for z in points
        ]
        expected = vector(*[min(ratio ** min(1.0, 4 / n), 7.4) for ratio in ratios])
        torch.testing.assert_close(pool.weights(x, sigma), expected, rtol=1e-10, atol=0)
    assert max(ratios) ** min(1.0, 4 / n) > 7.4 or n == 1  # the largest weight matters


def test_weights_of_one_gaussian_at_itself_are_one():
    pool, drawn = filled_pool(3, batches=1)
    torch.testing.assert_close(pool.weights(drawn[0][2], drawn[0][3]), torch.ones(4, dtype=torch.float64))


def test_a_point_at_x_itself_weighs_one():
    pool, drawn = filled_pool(2)
    assert float(pool.weights(drawn[1][0][2], 0.01)[4 + 2]) == 1.0


def test_the_latest_are_kept():
    pool, drawn = filled_pool(2, batches=5)
    every, latest = torch.cat([points for points, *_ in drawn]), pool.latest(9, vector(0.0, 0.0))
    assert torch.equal(latest.points, every[-9:])
    assert torch.equal(latest.values, every[-9:].sum(1))
    # What has been forgotten leaves no trace: eight of the last batch, one of the one before.
    fresh = Pool.empty(2).add(drawn[3][0][-1:], drawn[3][1][-1:], None, *drawn[3][2:])
    fresh = fresh.add(*drawn[4][:2], None, *drawn[4][2:])
    x = vector(0.1, 0.2)
    torch.testing.assert_close(latest.weights(x, 0.7), fresh.weights(x, 0.7), rtol=1e-13, atol=0)


def test_an_older_evaluation_is_kept_on_demand():
    pool, drawn = filled_pool(2, batches=5)
    every = torch.cat([points for points, *_ in drawn])
    kept = pool.latest(9, every[3])
    assert torch.equal(kept.points, torch.cat([every[3:4], every[-8:]]))
    assert torch.equal(kept.values, kept.points.sum(1))
    assert torch.equal(pool.latest(9, every[-2]).points, every[-9:])


def test_a_pool_never_changes():
    pool, _ = filled_pool(2)
    before = [one.clone() for one in (pool.points, pool.values, pool.centers, pool.sigmas, pool.origin)]
    pool.add(pool.points, pool.values, None, pool.points[0], 1.0)
    pool.thin(pool.points[0])
    pool.latest(3, pool.points[0])
    after = (pool.points, pool.values, pool.centers, pool.sigmas, pool.origin)
    assert all(torch.equal(x, y) for x, y in zip(before, after, strict=True))


def test_a_batch_without_values_changes_no_weight():
    pool, _ = filled_pool(2)
    before = pool.weights(vector(0.1, 0.2), 0.7)
    pool = pool.add(torch.zeros(0, 2, dtype=torch.float64), vector(), None, vector(5.0, 5.0), 0.1)
    torch.testing.assert_close(pool.weights(vector(0.1, 0.2), 0.7), before, rtol=1e-13, atol=0)


def test_a_thousand_dimensions():
    pool, drawn = filled_pool(1000)
    for sigma in (1e-3, 1.0, 1e3):
        weights = pool.weights(drawn[0][2], sigma)
        assert bool(torch.isfinite(weights).all())
        assert float(weights.max()) <= 7.4
    assert Pool.empty(1000).weights(drawn[0][2], 1.0).shape == (0,)


def test_outputs_go_with_their_points():
    pool, generator = Pool.empty(2), torch.Generator().manual_seed(0)
    assert pool.outputs is None
    for _ in range(3):
        points = normal(generator, 3, 2)
        pool = pool.add(points, points.sum(1), points.repeat(1, 3), points[0], 1.0).latest(5, points[0])
    thinned = pool.thin(pool.points[0])
    assert (len(pool), len(thinned)) == (5, 4)
    for one in (pool, thinned):
        assert torch.equal(one.outputs, one.points.repeat(1, 3))
        assert torch.equal(one.values, one.points.sum(1))


def thinned(points, losses):
    """Points that remain of these [P], one parameter."""
    pool = Pool.empty(1)
    for point, loss in zip(points, losses, strict=True):
        pool = pool.add(vector(point)[:, None], vector(loss), vector(loss)[:, None], vector(0.0), 1.0)
    rest = pool.thin(vector(0.0))
    assert torch.isfinite(rest.weights(vector(0.0), 1.0)).all()
    return rest.points[:, 0].tolist()


def test_the_worse_of_the_two_relatively_closest_is_dropped():
    """1.0 and 1.1 are close relative to their distance from 0; 0.0 and 0.3, and 0.3 and 1.0, are not."""
    assert thinned((0.0, 0.3, 1.0, 1.1, 4.0), (0.0, 1.0, 2.0, 3.0, 4.0)) == [0.0, 0.3, 1.0, 4.0]
    assert thinned((0.0, 0.3, 1.0, 1.1, 4.0), (0.0, 1.0, 3.0, 2.0, 4.0)) == [0.0, 0.3, 1.1, 4.0]
    assert thinned((0.0, 0.3, 1.0, 4.0, 0.31), (0.0, 1.0, 2.0, 4.0, -1.0)) == [0.0, 1.0, 4.0, 0.31]


def test_what_is_next_to_the_point_to_keep_is_dropped_before_it():
    """A millionth away from it: no farther than rounding, though relative to its own distance it is far."""
    assert thinned((0.0, 1e-6, 1.0, 1.2), (0.0, -1.0, 2.0, 3.0)) == [0.0, 1.0, 1.2]


def test_a_choice_of_points_is_denser_around_one_of_them():
    """Of points at 1, 1/2, 1/4, ... and twice as many about 1, all of the former and few of the latter."""
    halves = 0.5 ** torch.arange(8.0, dtype=torch.float64)
    heap = 1.0 + 1e-3 * torch.arange(1.0, 17.0, dtype=torch.float64)
    points = torch.cat([heap, torch.zeros(1, dtype=torch.float64), halves])[:, None]
    which = covering(points, vector(0.0), 9)
    assert len(which) == 9
    assert {16, *range(18, 25)} <= set(which.tolist())


def test_points_that_are_all_the_same_are_chosen_once_each():
    assert len(covering(torch.zeros(9, 2), torch.zeros(2), 5).unique()) == 5
    assert torch.equal(covering(torch.ones(3, 2), torch.ones(2), 5), torch.arange(3))
