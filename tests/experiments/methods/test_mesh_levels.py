"""Gauss-Newton on the vertices of a mesh: what it sees, what it is not told, and that it fits."""

from dataclasses import replace

import torch

from experiments.methods import METHODS
from experiments.methods.mesh_levels import Stage, toned
from experiments.problems import catalogue
from experiments.runs.trial import Trial


def test_the_curve_raises_what_is_dark_and_blocks_are_averaged():
    images = torch.zeros(1, 2, 4, 4)
    images[0, 1, :2, :2] = 0.25
    images[0, 1, 3, 3] = 0.8
    found = toned(images, 0.5, 2)
    expected = torch.zeros(1, 4, 2, 1).double()  # views below each other
    expected[0, 2, 0, 0] = 0.5 * 0.25 + 0.5 * 1.0
    expected[0, 3, 1, 0] = (0.5 * 0.8 + 0.5 * 1.0) / 4
    torch.testing.assert_close(found, expected)
    colored = toned(images[..., None] * torch.tensor([1.0, 0.5, 0.0]), 0.0, 1)
    torch.testing.assert_close(colored[0], images.view(8, 4, 1).double() * torch.tensor([1.0, 0.5, 0.0]).double())


def test_a_sphere_becomes_more_like_a_bunny_without_cameras():
    """A few Jacobians and their steps, on a mesh that does not know who sees it; then handles in space."""
    task = catalogue.load("meshfit_color")
    blind = replace(task, mesh=replace(task.mesh, cameras=None))
    trial = Trial(blind, "levels_local", 1000)
    METHODS["levels_local"].solve(trial, {"stages": (Stage(1, 120, 0.15, 2), Stage(None, 60, 0.3, 4)), "samples": 48})
    assert trial.evaluations <= 1 + 120 + 48 + 1 + 60 + 48
    assert trial.rows[-1].image_error < 0.7 * trial.rows[0].image_error
    before, after = (task.truth.measures(x)["least silhouette IoU"] for x in (trial.start, trial.x))
    assert after > before + 0.05


def test_it_is_for_meshes():
    assert METHODS["levels_local"].unusable(catalogue.load("suzanne")) is None
    assert "not the vertices of a mesh" in METHODS["levels_local"].unusable(catalogue.load("texture"))
