"""What a search chooses for a sparse fit: a grid of the parameters, and the entries of a row.

Random tests have fixed seeds.
"""

from dataclasses import replace

import pytest
import torch

from torch_zerohess.surrogates import sparse_choices
from torch_zerohess.surrogates.sparse_choices import GridEvidence, fit_chosen, guessed_grid, kept
from torch_zerohess.surrogates.sparse_fit import SparseSettings, fit_sparse
from truths import normal

SIDE = 16
SHAPE = torch.Size([SIDE, SIDE])


@pytest.mark.parametrize(
    ("n", "shape", "grid"),
    [
        (1024, (64, 64), (32, 32, 1)),
        (1024, (96, 96, 3), (32, 32, 1)),
        (768, (20, 20, 3), (16, 16, 3)),
        (1200, (38, 28), (40, 30, 1)),
        (192, (4, 48, 64, 3), (12, 16, 1)),
        (192, (3, 48, 64), (12, 16, 1)),
        (1200, (64, 64), None),
        (1021, (64, 64), None),
        (1024, (4096,), None),
        (36, (64, 64), None),
    ],
)
def test_a_grid_has_the_proportions_of_the_image(n, shape, grid):
    assert guessed_grid(n, torch.Size(shape)) == grid


def blurred(order):
    """The changes of an image of 16x16, each pixel nine texels, whose order as parameters is given."""
    u = normal(40, SIDE**2, seed=1)
    image = torch.nn.functional.avg_pool2d(u[:, order].view(-1, 1, SIDE, SIDE), 3, 1, 1)
    return u, image.flatten(1)


def test_a_grid_is_taken_where_held_out_samples_confirm_it():
    plain = SparseSettings(12)
    for order, taken in ((torch.arange(SIDE**2), True), (torch.randperm(SIDE**2), False)):
        u, changes = blurred(order)
        fitted, evidence = fit_chosen(u, changes, SHAPE, plain, None, GridEvidence())
        alone = fit_sparse(u, changes, SHAPE, plain)
        assert evidence.tests <= 1
        assert (fitted.explained > alone.explained + 0.3) == taken
        assert (evidence.settings(plain, SHAPE, SIDE**2).grid == (SIDE, SIDE, 1)) == taken
        assert taken or torch.equal(fitted.values, alone.values)


def test_grids_are_compared_three_times_and_not_where_little_is_left(monkeypatch):
    fits = []
    monkeypatch.setattr(sparse_choices, "fit_sparse", lambda *given: fits.append(given[3].grid) or fit_sparse(*given))
    u, changes = blurred(torch.arange(SIDE**2))
    evidence = GridEvidence()
    for _ in range(4):
        _, evidence = fit_chosen(u, changes, SHAPE, SparseSettings(12), None, evidence)
    assert fits == 3 * [None, (SIDE, SIDE, 1)] + [(SIDE, SIDE, 1)]
    fits.clear()
    fit_chosen(u, u.clone(), SHAPE, SparseSettings(12), None, GridEvidence())
    told = SparseSettings(12, grid=(8, 32, 1))
    fit_chosen(u, changes, SHAPE, told, None, GridEvidence())
    assert fits == [None, (8, 32, 1)]


def test_full_rows_may_have_twice_the_entries_in_the_next_fit():
    settings = SparseSettings(16, grows=True)
    u = normal(200, SIDE**2)
    full = fit_sparse(u, u @ normal(SIDE**2, SIDE**2, seed=1), SHAPE, settings)
    assert bool(full.found.all())
    full = replace(full, explained=0.9)
    assert kept(settings, full, 32) == 32
    assert kept(replace(settings, grows=False), full, 32) == 16
    assert kept(settings, replace(full, explained=0.995), 32) == 16
    few = full.values.where(torch.arange(SIDE**2)[:, None] < 100, 0.0)
    assert kept(settings, replace(full, values=few), 32) == 16
    wide = replace(full, **{name: getattr(full, name).repeat(1, 4) for name in ("index", "values", "standard_error")})
    assert kept(settings, wide, 32) == 64


def test_a_first_fit_has_fewer_entries_than_samples():
    """With as many, 16 entries and 12 samples, the error is .38."""
    u = normal(12, SIDE**2)
    fitted, _ = fit_chosen(u, u.clone(), SHAPE, SparseSettings(16, grid=(SIDE, SIDE, 1)), None, GridEvidence())
    assert fitted.values.shape[1] == 10
    assert float((fitted.dense().view(SIDE**2, -1) - torch.eye(SIDE**2)).norm()) < 0.1 * SIDE


def test_a_comparison_counts_where_either_fit_predicts_something():
    """Noise of five times the image leaves nothing to predict: what is best there is of no later use."""
    u, changes = blurred(torch.arange(SIDE**2))
    noisy = changes + 5 * changes.std() * normal(*changes.shape, seed=2)
    _, evidence = fit_chosen(u, noisy, SHAPE, SparseSettings(12), None, GridEvidence())
    assert evidence == GridEvidence()
