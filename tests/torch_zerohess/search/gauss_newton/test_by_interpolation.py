"""Gauss-Newton on interpolated outputs, from evaluations that another search has made."""

from dataclasses import replace

import pytest
import torch
from searches import misfit

from torch_zerohess.search.gauss_newton.by_interpolation import OutputGaussNewton
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.state import Best, Evaluated
from truths import vector


def plane(x):
    return x @ vector(1.0, 2.0, -1.0, 1.0, 0.0, 1.0).view(2, 3)


@pytest.mark.parametrize("bound", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_it_looks_off_a_bound_on_which_all_evaluations_lie(bound, seed):
    """They say nothing about the slope there: with a slope of zero the best one would be a minimum."""
    solution, generator = vector(0.5, 0.3), torch.Generator().manual_seed(seed)
    loss = misfit(plane, solution)

    def evaluated(points):
        outputs = plane(points)
        return Evaluated(points, torch.stack([loss(one) for one in outputs]), outputs, outputs.shape[1:])

    lower, upper = torch.zeros_like(solution), torch.ones_like(solution)
    method = OutputGaussNewton(Settings(solution, lower, upper, loss, 0, 1e-3, 0.0, None), capacity=80)
    along = 0.2 * 0.5 ** torch.arange(40, dtype=torch.float64)  # near at every width of the region
    known = evaluated(torch.stack([torch.full_like(along, bound), 0.3 + along], 1))
    lowest = int(known.losses.argmin())
    begun = method._begun(Best(known.points[lowest], float(known.losses[lowest]), 0.1))
    begun = begun.holding(known.points, known.losses, outputs=known.outputs, shape=known.shape)
    progress, points = method.plan(replace(begun, sigma=0.1), generator)
    while len(points):
        progress, points = method.next(progress, evaluated(points), generator)
    assert progress.done
    torch.testing.assert_close(progress.lowest.point, solution, rtol=0, atol=1e-6)
