"""MESHFIT: the task, its measures, handles and the fit."""

import math

import pytest
import torch

from experiments.methods import METHODS
from experiments.methods.mesh_handles import DAMPING, _losses, _newton
from experiments.problems import catalogue
from experiments.problems.scenes import mesh_targets
from experiments.problems.scenes.fitted_mesh import FittedMesh
from experiments.problems.scenes.raster import Cameras
from experiments.problems.tasks import meshfit
from experiments.runs.trial import Trial

TASK = catalogue.load("meshfit")


COLORED = ("meshfit_color", "banana")


@pytest.mark.parametrize(("name", "n"), [(name, (6 if name in COLORED else 3) * 2562) for name in mesh_targets.TARGETS])
def test_task(name, n) -> None:
    task = catalogue.load(name)
    x = torch.stack([task.start(run) for run in range(2)])
    assert (task.name, task.n, tuple(x.shape)) == (name, n, (2, n))
    assert torch.equal(task.start(0), x[0])
    rows = task.mesh.rows(x)
    radius = (rows[..., :3] - rows[..., :3].mean(1, keepdim=True)).norm(dim=2)
    assert bool(((radius > 0.4 - 1e-9) & (radius < 0.5 + 1e-9)).all())
    assert bool((rows[..., 3:] == 0.5).all())
    losses = task.loss(x)
    for image, loss, one in zip(task.output.image(x), losses, x, strict=True):
        assert float(task.output.loss(image)) == pytest.approx(float(loss), rel=1e-4)  # images are float32
        assert task.truth.image_error(one) == pytest.approx(float(loss), rel=1e-6)
    assert task.picture.of(x[0]).shape == task.picture.target().shape == ((128, 256) if n < 10000 else (128, 256, 3))
    assert 0 <= float(task.picture.target().min()) < float(task.picture.target().max()) <= 1
    # The target stays within its views.
    for edge in (
        task.picture.target()[0],
        task.picture.target()[-1],
        task.picture.target()[:, 0],
        task.picture.target()[:, -1],
    ):
        assert not bool(edge.any())
    assert METHODS["handles_newton"].applies(task) is None
    assert "not the vertices of a mesh" in METHODS["handles_newton"].applies(catalogue.load("quad"))


def test_silhouette_iou_is_that_of_spheres() -> None:
    fit = meshfit.MeshFit(128, mesh_targets.bunny())
    x = fit.start(0)
    centred = 0.3 * fit.mesh.sphere.flatten()
    fit._covered = fit.mesh.render(centred[None])[0] > 0
    torch.testing.assert_close(fit.silhouette_iou(centred), torch.ones(8))
    # Concentric discs of radius r d / sqrt(d^2 - r^2).
    inner, outer = (r**2 / (meshfit.DISTANCE**2 - r**2) for r in (0.3, 0.45))
    found = fit.silhouette_iou(0.45 * fit.mesh.sphere.flatten())
    torch.testing.assert_close(found.double(), torch.full((8,), inner / outer).double(), rtol=0.02, atol=0)
    named = fit.measures(x)
    assert min(fit.silhouette_iou(x).tolist()) == named["least silhouette IoU"] < 1
    assert len(named) == 9


def test_chamfer_is_the_squared_distance_of_parallel_surfaces() -> None:
    fit = meshfit.MeshFit(8, mesh_targets.bunny())
    sphere, faces = fit.mesh.sphere.numpy(), fit.mesh.faces.numpy()
    fit._points = meshfit._spread(sphere, faces)
    fit._tree = meshfit.cKDTree(fit._points)
    assert fit.chamfer(fit.mesh.sphere.flatten()) == 0.0
    assert fit.chamfer(1.2 * fit.mesh.sphere.flatten()) == pytest.approx(0.2**2, rel=0.02)
    assert fit.chamfer(torch.full((fit.mesh.n,), math.nan)) == math.inf


def test_handles_in_space_move_what_is_near_them() -> None:
    """All of them by one vector: the whole mesh by it. One of them: both sides of a sheet, however thin."""
    mesh = meshfit.task().mesh
    assert mesh is not None
    sheet = (mesh.sphere * torch.tensor([1.0, 1.0, 1e-3], dtype=torch.float64)).flatten()
    handles = mesh.lattice(sheet, 0.3)
    vector = torch.tensor([1.0, 2.0, -3.0], dtype=torch.float64)
    moved = mesh.rows(handles.displaced(sheet, vector.expand(1, len(handles), 3))[0] - sheet)
    assert float((moved - vector).abs().max()) < 0.05 * float(vector.norm())
    one = handles.matrix[:, int(handles.matrix.amax(0).argmax())]
    below = torch.cdist(mesh.sphere, mesh.sphere * torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)).argmin(1)
    assert float((one - one[below]).abs().max()) < 0.01 * float(one.max())
    assert float(one[(mesh.sphere[:, :2] - mesh.sphere[int(one.argmax()), :2]).norm(dim=1) > 1.3].max()) == 0.0


def test_a_handle_sums_all_pixels_that_it_changes_and_few_others() -> None:
    mesh, x = TASK.mesh, TASK.start(0)
    whole = TASK.output.image(x[None])
    for level, most in ((2, 0.35), (3, 0.15)):
        control = mesh.control(level)
        sums = control.sums(x, margin=2.0)
        for handle in (0, 20, len(control) - 1):
            z = torch.zeros(1, len(control), 3, dtype=torch.float64)
            z[0, handle] = 0.01  # less than a pixel
            change = (TASK.output.image(control.displaced(x, z)) - whole).abs()
            assert float(change.sum()) > 0
            # Almost all: displacements below a hundredth do not count, but may turn a triangle a little.
            inside = float(sums(change)[0, handle])
            assert inside > 0.95 * float(change.sum())
            assert float(sums(torch.ones_like(change))[0, handle]) < most * change.numel()


def test_box_sums_are_sums() -> None:
    mesh, x = FittedMesh(Cameras.around(2, (0.0,), 3.0, 12, 1.0), 1), None
    x = 0.9 * mesh.sphere.flatten()
    sums = mesh.control(0).sums(x, margin=0.5)
    images = torch.rand(3, 2, 12, 12, generator=torch.Generator().manual_seed(0)).double()
    found = sums(images)
    for handle in range(12):
        expected = torch.zeros(3, dtype=torch.float64)
        for view in range(2):
            rows = slice(int(sums.top[view, handle]), int(sums.bottom[view, handle]))
            columns = slice(int(sums.left[view, handle]), int(sums.right[view, handle]))
            expected += images[:, view, rows, columns].sum((1, 2))
        torch.testing.assert_close(found[:, handle], expected)


def test_losses_of_handles_share_their_renders() -> None:
    trial = Trial(TASK, "x", 0)
    control = TASK.mesh.control(1)
    unit = torch.full((3,), 0.1, dtype=torch.float64)
    losses = _losses(trial, control, trial.start, unit, margin=1000.0, silhouette=0.0)
    z = torch.randn(2, len(control), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = losses(z)
    assert trial.evaluations == 2
    # With boxes as large as the images every handle has the whole loss of the image that it was in.
    whole = TASK.loss(control.displaced(trial.start, z * unit))
    torch.testing.assert_close(found, whole[:, None].expand(2, len(control)), rtol=1e-4, atol=0)


@pytest.mark.parametrize("name", ["meshfit", "meshfit_color"])
def test_a_pixel_that_only_one_covers_counts_more(name) -> None:
    task = catalogue.load(name)
    trial, control = Trial(task, "x", 0), task.mesh.control(0)
    zero = torch.zeros(len(control), task.mesh.channels, dtype=torch.float64)
    unit = torch.ones(task.mesh.channels, dtype=torch.float64)
    without, found = (
        _losses(trial, control, trial.start, unit, margin=1000.0, silhouette=weight)(zero[None])[0]
        for weight in (0.0, 0.5)
    )
    mesh, target = (
        task.output.image(trial.start[None])[0],
        -task.output.residuals(torch.zeros_like(task.output.image(trial.start[None])[0])),
    )
    shown = [picture.view(8, 64, 64, -1).sum(3) > 1e-6 for picture in (mesh, target)]
    mistaken = (shown[0] ^ shown[1]).sum().double()
    assert mistaken > 100
    torch.testing.assert_close(found - without, (0.5 * mistaken / mesh.numel()).expand(len(control)), rtol=1e-4, atol=0)


def test_newton_steps_go_to_the_minimum_of_each_block() -> None:
    generator = torch.Generator().manual_seed(0)
    a = torch.randn(5, 3, 3, generator=generator, dtype=torch.float64)
    blocks = a @ a.mT + torch.eye(3)
    minimum = torch.randn(5, 3, generator=generator, dtype=torch.float64)
    gradient = -(blocks @ minimum[..., None])[..., 0]
    damped = blocks + meshfit_damping(blocks)
    expected = torch.linalg.solve(damped, -gradient)
    torch.testing.assert_close(_newton(gradient, blocks, 1.0, 1e9), expected)
    short = _newton(gradient, blocks, 1.0, 1e-3)
    torch.testing.assert_close(short.norm(dim=1), torch.full((5,), 1e-3, dtype=torch.float64))
    assert bool(((short * expected).sum(1) > 0).all())


def meshfit_damping(blocks):
    return DAMPING * torch.linalg.eigvalsh(blocks).mean() * torch.eye(3, dtype=torch.float64)


SHORT = {"levels": (1,), "steps": 6, "samples": 4}


@pytest.mark.parametrize("newton", [0, 1])
def test_a_few_steps_lower_the_error(newton) -> None:
    torch.manual_seed(0)
    trial = Trial(TASK, "handles_newton", 1000)
    METHODS["handles_newton"].solve(trial, {**SHORT, "newton": newton})
    assert trial.evaluations == 48
    first, last = trial.rows[0], trial.rows[-1]
    assert last.image_error < 0.95 * first.image_error


def test_colors_are_fitted_with_the_vertices() -> None:
    torch.manual_seed(0)
    task = catalogue.load("meshfit_color")
    trial = Trial(task, "handles_newton", 1000)
    METHODS["handles_newton"].solve(trial, {**SHORT, "newton": 0, "silhouette": 0.0})
    assert trial.rows[-1].image_error < 0.95 * trial.rows[0].image_error
    x = task.mesh.rows(trial.x)
    assert float((x[:, 3:] - 0.5).abs().max()) > 0.01
    # With the places kept, new colours alone change the image to the better.
    grey = x.clone()
    grey[:, 3:] = 0.5
    assert task.truth.image_error(trial.x) < task.truth.image_error(grey.flatten())
