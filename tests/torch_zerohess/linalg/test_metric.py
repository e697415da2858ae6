"""A learned metric against the exact inverse root, and steps against a search over the region."""

import pytest
import torch

from torch_zerohess.linalg.metric import learned, region_step
from truths import vector


def rotated(values, seed=0):
    n = len(values)
    q, _ = torch.linalg.qr(torch.randn(n, n, generator=torch.Generator().manual_seed(seed), dtype=torch.float64))
    return (q * vector(*values)) @ q.mT


def test_at_full_rate_the_metric_is_the_inverse_root_of_the_hessian():
    H = rotated([1.0, -4.0, 100.0])
    root = learned(torch.eye(3, dtype=torch.float64), H, 1.0)
    values = torch.linalg.eigvalsh(root @ H @ root)
    torch.testing.assert_close(values.abs(), values.abs().mean().expand(3))
    assert float(torch.linalg.det(root)) == pytest.approx(1.0)
    torch.testing.assert_close(root, root.mT)


def test_half_of_the_rate_is_half_of_the_logarithm():
    H = torch.diag(vector(1.0, 16.0))
    root = learned(torch.eye(2, dtype=torch.float64), H, 0.5)
    torch.testing.assert_close(root, torch.diag(vector(2.0**0.5, 0.5**0.5)))


def test_curvature_below_the_floor_is_taken_as_the_floor():
    root = learned(torch.eye(2, dtype=torch.float64), torch.diag(vector(1e-12, 1e-9)), 1.0, floor=1e-3)
    torch.testing.assert_close(root, torch.eye(2, dtype=torch.float64))


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    "borders",
    [None, vector(1.0, -1.0, 0.5, 0.1)[None], vector(1.0, -1.0, 0.5, 0.1, -1.0, 0.5, 1.0, 0.05).view(2, 4)],
    ids=["", "beside a border", "in a corner"],
)
def test_a_step_in_a_box_is_as_low_as_any_of_many_points(seed, borders):
    generator = torch.Generator().manual_seed(seed)
    root, H = rotated([0.5, 1.0, 2.0], seed), rotated([-1.0, 0.5, 3.0], seed + 10)
    g = torch.randn(3, generator=generator, dtype=torch.float64)
    lower, upper = vector(-0.3, -2.0, -0.1), vector(0.5, 0.2, 2.0)
    s = region_step(g, H, root, lower, upper, borders=borders)  # the active set is a guess: within 5 %
    assert bool(((s >= lower) & (s <= upper)).all())
    assert borders is None or bool((borders[:, :-1] @ s <= borders[:, -1] + 1e-9).all())

    def model(z):
        return z @ g + 0.5 * ((z @ H) * z).sum(-1)

    u = torch.randn(20_000, 3, generator=generator, dtype=torch.float64)
    every = (torch.rand(20_000, 1, generator=generator) ** 0.3 * u / u.norm(dim=1, keepdim=True)) @ root
    inside = ((every >= lower) & (every <= upper)).all(1)
    if borders is not None:
        inside &= (every @ borders[:, :-1].mT <= borders[:, -1]).all(1)
    assert float(model(s)) < 0.95 * float(model(every[inside]).min())


def test_a_step_gives_up_a_bound_that_does_not_hold_it():
    """|s - (1.7, 1.9)|^2/2 is least at (0.1, 0.7) on 0.8 x + 0.6 y = 0.5. On the way from 0, x <= 0.3 is met first."""
    lower, upper = vector(-torch.inf, -torch.inf), vector(0.3, torch.inf)
    one = torch.eye(2, dtype=torch.float64)
    s = region_step(vector(-1.7, -1.9), one, 4.0 * one, lower, upper, borders=vector(0.8, 0.6, 0.5)[None])
    torch.testing.assert_close(s, vector(0.1, 0.7))


def test_without_bounds_in_the_way_it_is_the_step_of_the_ball():
    root, far = torch.diag(vector(3.0, 1.0)), vector(9.0, 9.0)
    s = region_step(vector(1.0, 0.0), torch.zeros(2, 2).double(), root, -far, far)
    torch.testing.assert_close(s, vector(-3.0, 0.0))
