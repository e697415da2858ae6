"""MESHFIT: the rasteriser against closed forms and a pixel loop, meshes and subdivision, the target, and the fit."""

import math
import struct
import sys

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from experiments.methods import METHODS
from experiments.methods.meshes import DAMPING, _losses, _newton
from experiments.problems import catalogue
from experiments.problems.scenes import mesh_targets, stanford
from experiments.problems.scenes.fitted_mesh import FittedMesh
from experiments.problems.scenes.icosphere import icosphere, split, vertex_normals
from experiments.problems.scenes.raster import AMBIENT, LAMP, Cameras, render
from experiments.problems.scenes.subdivision import bumps, smoothing, subdivision
from experiments.problems.tasks import meshfit
from experiments.runs.trial import Trial

TASK = catalogue.load("meshfit")
FRONT = Cameras(torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64), side=64, extent=1.0)
LIGHT = np.array(LAMP) / np.linalg.norm(LAMP)


def lambert(normal) -> float:
    return AMBIENT + (1 - AMBIENT) * max(0.0, float(np.dot(normal, LIGHT)))


def quad(left, right, bottom, top, z):
    return [[left, bottom, z], [right, bottom, z], [right, top, z], [left, top, z]]


TWO = torch.tensor([[0, 1, 2], [0, 2, 3]])


def test_a_square_covers_its_pixels_and_is_lit_by_its_normal() -> None:
    # Centres of pixels are at (2 i + 1) / 64 - 1 on the plane through the origin, where the film is 2 wide.
    image = render(FRONT, torch.tensor([quad(-0.5, 0.25, -0.75, 0.5, 0.0)]), TWO)[0, 0]
    expected = torch.zeros(64, 64)
    expected[16:56, 16:40] = lambert([0, 0, 1])
    torch.testing.assert_close(image, expected)
    behind = render(FRONT, torch.tensor([quad(-0.5, 0.25, -0.75, 0.5, 0.0)]), TWO.flip(1))[0, 0]
    torch.testing.assert_close(behind, expected.where(expected == 0, torch.tensor(AMBIENT)))


def test_perspective_of_a_square_behind_the_origin() -> None:
    # At depth 4 instead of 3 everything is 3/4 as large.
    image = render(FRONT, torch.tensor([quad(-0.5, 0.5, -0.5, 0.5, -1.0)]), TWO)[0, 0]
    assert int((image > 0).sum()) == 24**2
    assert bool((image[20:44, 20:44] > 0).all())


@pytest.mark.parametrize("order", [[0, 1], [1, 0]])
def test_the_nearer_of_two_triangles_is_seen(order) -> None:
    tilted = [[-0.8, -0.8, 0.3], [0.8, -0.8, -0.3], [0.0, 0.8, 0.0]]
    flat = [[-0.8, -0.8, 0.0], [0.8, -0.8, 0.0], [0.0, 0.8, 0.0]]
    normal = np.cross(np.subtract(tilted[1], tilted[0]), np.subtract(tilted[2], tilted[0]))
    both = torch.tensor([tilted, flat])[order].reshape(1, 6, 3)
    image = render(FRONT, both, torch.arange(6).view(2, 3))[0, 0]
    # They meet at x = 0, where both have z = 0; the tilted one is in front on the left.
    left, right = image[40, 24:31], image[40, 33:40]
    torch.testing.assert_close(left, torch.full_like(left, lambert(normal / np.linalg.norm(normal))))
    torch.testing.assert_close(right, torch.full_like(right, lambert([0, 0, 1])))


def test_the_silhouette_of_a_sphere_is_its_disc() -> None:
    cameras = Cameras.around(3, (20.0, -40.0, 0.0), 3.0, 256, 1.0)
    vertices, faces = icosphere(5)
    covered = render(cameras, torch.from_numpy(0.5 * vertices)[None], torch.from_numpy(faces))[0] > 0
    # The cone that touches the sphere meets the plane through the origin in a disc of radius r d / sqrt(d^2 - r^2).
    radius = 0.5 * 3.0 / math.sqrt(3.0**2 - 0.5**2)
    area = math.pi * radius**2 / 4 * 256**2
    for view in covered:
        assert int(view.sum()) == pytest.approx(area, rel=2e-3)
        rows, columns = torch.nonzero(view).unbind(1)
        assert float(rows.double().mean()) == pytest.approx(127.5, abs=0.1)
        assert float(columns.double().mean()) == pytest.approx(127.5, abs=0.1)


def test_a_watertight_mesh_has_no_holes() -> None:
    cameras = Cameras.around(8, (25.0, -25.0), 3.0, 96, 1.0)
    vertices, faces = icosphere(4)
    generator = torch.Generator().manual_seed(0)
    meshes = torch.from_numpy(vertices) + 0.01 * torch.randn(4, *vertices.shape, generator=generator)
    covered = render(cameras, 0.7 * meshes, torch.from_numpy(faces)) > 0
    axis = (torch.arange(96) + 0.5) / 48 - 1
    inside = axis[:, None] ** 2 + axis**2 < 0.6**2  # well within the silhouette of radius 0.7 +- 0.03
    assert bool(covered[:, :, inside].all())


def brute_force(cameras, vertices, faces, colors):
    """Every pixel against every triangle, by rays through the centres of pixels in space."""
    image = np.zeros((cameras.side, cameras.side, 3))
    axes, eye = cameras.axes[0].numpy(), cameras.eyes[0].numpy()
    distance = np.linalg.norm(eye)
    for row in range(cameras.side):
        for column in range(cameras.side):
            u, v = (2 * np.array([column, cameras.side - 1 - row]) + 1) / cameras.side - 1
            ray = cameras.extent * (u * axes[0] + v * axes[1]) - distance * axes[2]
            nearest = np.inf
            for face in faces:
                a, b, c = vertices[face]
                try:
                    # eye + t ray = a + s1 (b - a) + s2 (c - a)
                    t, s1, s2 = np.linalg.solve(np.stack([ray, a - b, a - c], 1), a - eye)
                except np.linalg.LinAlgError:
                    continue
                if min(s1, s2, 1 - s1 - s2) >= 0 and 0 < t < nearest:
                    nearest = t
                    normal = np.cross(b - a, c - a)
                    cosine = axes @ (normal / np.linalg.norm(normal)) @ LIGHT
                    shade = AMBIENT + (1 - AMBIENT) * max(0.0, cosine)
                    image[row, column] = shade * (
                        (1 - s1 - s2) * colors[face[0]] + s1 * colors[face[1]] + s2 * colors[face[2]]
                    )
    return image


def test_against_a_loop_over_rays() -> None:
    cameras = Cameras.around(2, (35.0, -20.0), 2.5, 20, 1.0)
    generator = np.random.default_rng(3)
    vertices, colors = generator.normal(0, 0.5, (3, 12, 3)), generator.random((3, 12, 3))
    faces = np.array([[0, 1, 2], [3, 4, 5], [6, 7, 8], [9, 10, 11], [0, 5, 10]])
    images = render(cameras, torch.from_numpy(vertices), torch.from_numpy(faces), torch.from_numpy(colors))
    grey = render(cameras, torch.from_numpy(vertices), torch.from_numpy(faces), torch.ones(3, 12, 3))
    torch.testing.assert_close(grey[..., 0], render(cameras, torch.from_numpy(vertices), torch.from_numpy(faces)))
    for k in range(3):
        for view in range(2):
            one = Cameras(cameras.eyes[view : view + 1], cameras.side, cameras.extent)
            expected = brute_force(one, vertices[k], faces, colors[k])
            assert (expected > 0).any()
            np.testing.assert_allclose(images[k, view].numpy(), expected, atol=1e-4)


def test_render_ignores_what_is_behind_the_camera_or_not_a_number() -> None:
    behind = torch.tensor([quad(-9.0, 9.0, -9.0, 9.0, 3.5)])
    assert not bool(render(FRONT, behind, TWO).any())
    assert not bool(render(FRONT, torch.full((1, 4, 3), math.nan), TWO).any())
    whole = render(FRONT, torch.tensor([quad(-1e6, 1e6, -1e6, 1e6, 0.0)]), TWO)
    assert bool((whole > 0).all())


def test_batches_do_not_change_images(monkeypatch) -> None:
    x = torch.stack([TASK.start(run) for run in range(3)])
    images = TASK.output.image(x)
    assert images.shape == (3, 8, 64, 64)
    monkeypatch.setattr("experiments.problems.scenes.raster._CORNERS", 1)
    assert torch.equal(TASK.output.image(x), images)


@pytest.mark.parametrize("level", [0, 1, 3])
def test_icosphere(level) -> None:
    vertices, faces = icosphere(level)
    assert (len(vertices), len(faces)) == (10 * 4**level + 2, 20 * 4**level)
    np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0, rtol=1e-12)
    same = trimesh.creation.icosphere(level)  # turned, and in another order
    lengths = np.sort(trimesh.Trimesh(vertices, faces, process=False).edges_unique_length)
    np.testing.assert_allclose(lengths, np.sort(same.edges_unique_length), rtol=1e-9)
    edges = {tuple(edge) for face in faces for edge in (face[[0, 1]], face[[1, 2]], face[[2, 0]])}
    assert len(edges) == 3 * len(faces)  # each once in each direction: closed and consistently wound
    assert all((b, a) in edges for a, b in edges)
    assert bool((np.linalg.det(vertices[faces]) > 0).all())
    if level:
        np.testing.assert_array_equal(icosphere(level - 1)[0], vertices[: 10 * 4 ** (level - 1) + 2])
    with pytest.raises(ValueError, match="level must be at least 0"):
        icosphere(-1)


def test_subdivision_has_the_weights_of_loop() -> None:
    vertices, faces = icosphere(1)  # vertices of 5 neighbours, and of 6, whose limit is regular
    matrix, (_, ends) = subdivision(faces, len(vertices)).toarray(), split(faces, len(vertices))
    neighbours = [set(faces[(faces == i).any(1)].ravel()) - {i} for i in range(len(vertices))]
    for i, row in enumerate(matrix[: len(vertices)]):
        k = len(neighbours[i])
        beta = {5: (5 / 8 - (3 / 8 + math.cos(2 * math.pi / 5) / 4) ** 2) / 5, 6: 1 / 16}[k]
        expected = np.zeros(len(vertices))
        expected[list(neighbours[i])] = beta
        expected[i] = 1 - k * beta
        np.testing.assert_allclose(row, expected, atol=1e-15)
    for (a, b), row in zip(ends, matrix[len(vertices) :], strict=True):
        expected = np.zeros(len(vertices))
        expected[[a, b]] = 3 / 8
        expected[list(neighbours[a] & neighbours[b])] = 1 / 8
        np.testing.assert_allclose(row, expected, atol=1e-15)


def test_subdivision_is_that_of_trimesh() -> None:
    vertices, faces = icosphere(2)
    rough = vertices * (1 + 0.1 * np.sin(5 * vertices[:, :1]))
    expected, _ = trimesh.remesh.subdivide_loop(rough, faces, iterations=1)
    found = subdivision(faces, len(vertices)) @ rough
    np.testing.assert_allclose(found[: len(vertices)], expected[: len(vertices)], atol=1e-12)
    # The old vertices come first in both. The new ones have another order in trimesh.
    distance, match = cKDTree(found).query(expected)
    assert distance.max() < 1e-12
    assert sorted(match) == list(range(len(found)))


def test_bumps_are_a_partition_of_unity_around_their_handles() -> None:
    fine, _ = icosphere(3)
    for coarse in (0, 1, 2, 3):
        handles, faces = icosphere(coarse)
        matrix = bumps(coarse, 3).toarray()
        assert matrix.shape == (len(fine), len(handles))
        np.testing.assert_allclose(matrix.sum(1), 1.0)
        assert bool((matrix >= 0).all())
        assert matrix[np.arange(len(handles)), np.arange(len(handles))].min() > 0.4
        centre = matrix.T @ fine
        cosine = (centre * handles).sum(1) / np.linalg.norm(centre, axis=1)
        assert cosine.min() > 0.999
    np.testing.assert_array_equal(bumps(3, 3).toarray(), smoothing(faces, len(handles)).toarray())
    with pytest.raises(ValueError, match="coarse must be between 0 and fine = 1, got 2"):
        bumps(2, 1)


def ply(header: str, vertices, faces) -> bytes:
    body = b"".join(struct.pack("<3f", *v) for v in vertices) + b"".join(struct.pack("<B3i", 3, *f) for f in faces)
    return header.encode() + b"end_header\n" + body


HEADER = (
    "ply\nformat binary_little_endian 1.0\nobj_info made by hand\nelement vertex 4\nproperty float x\n"
    "property float y\nproperty float z\nelement face 2\nproperty list uchar int vertex_indices\n"
)


def test_read_ply(tmp_path) -> None:
    path = tmp_path / "square.ply"
    square = quad(0.0, 1.0, 0.0, 2.0, 0.5)
    path.write_bytes(ply(HEADER, square, TWO.tolist()))
    vertices, faces = stanford.read_ply(path)
    np.testing.assert_array_equal(vertices, square)
    np.testing.assert_array_equal(faces, TWO.numpy())


def volume(vertices, faces) -> float:
    return float(np.linalg.det(vertices[faces]).sum() / 6)


def test_cluster_keeps_the_shape() -> None:
    vertices, faces = icosphere(5)
    merged, left = stanford.cluster(vertices, faces, 0.1)
    assert len(merged) < 0.4 * len(vertices)
    assert set(left.ravel()) == set(range(len(merged)))
    assert len(np.unique(np.sort(left, axis=1), axis=0)) == len(left)
    assert volume(merged, left) == pytest.approx(volume(vertices, faces), rel=0.02)
    a, b, c = (merged[left[:, k]] for k in range(3))
    assert bool(((np.cross(b - a, c - a) * (a + b + c)).sum(1) > 0).all())


@pytest.mark.parametrize("source", ["pymeshfix", "procedural"])
def test_bunny(source, monkeypatch) -> None:
    if source == "procedural":
        monkeypatch.setattr(stanford, "_scan", lambda: None)
    (vertices, normals, faces), found = stanford.bunny_surface()
    assert found in (source, "procedural")  # without the package both are the same
    assert faces.dtype == np.uint32
    assert int(faces.max()) == len(vertices) - 1
    np.testing.assert_allclose(vertices.min(0) + vertices.max(0), 0.0, atol=1e-12)
    assert np.ptp(vertices[:, 1]) == pytest.approx(1.0)
    assert 0.3 < np.ptp(vertices[:, 2]) <= np.ptp(vertices[:, 0]) < 1.1
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert 0.08 < volume(vertices, faces) < 0.4  # positive: wound outward
    np.testing.assert_allclose(normals, vertex_normals(vertices, faces))
    assert np.mean((normals * vertices).sum(1) > 0) > 0.7
    # Ears: the upper fifth is thin.
    assert 0.0 < np.mean(vertices[:, 1] > 0.3) < 0.2


def test_a_scan_that_is_not_installed_is_not_found(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pymeshfix", None)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert stanford._scan() is None


def edges_of(faces) -> list[tuple[int, int]]:
    return [tuple(edge) for face in faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)]


@pytest.mark.parametrize("make", [mesh_targets.suzanne, mesh_targets.banana])
def test_targets_of_the_source_are_closed_and_wound_outward(make, monkeypatch) -> None:
    monkeypatch.setattr(mesh_targets, "_blender", lambda: None)
    found = make()
    assert found.source == "procedural"
    assert set(found.faces.ravel()) == set(range(len(found.vertices)))
    edges = edges_of(found.faces)
    assert len(set(edges)) == len(edges)  # each once in each direction
    assert {(b, a) for a, b in edges} == set(edges)
    np.testing.assert_allclose(found.vertices.min(0) + found.vertices.max(0), 0.0, atol=1e-12)
    assert np.ptp(found.vertices, axis=0).max() == pytest.approx(1.0)
    assert volume(found.vertices, found.faces) > 0.01
    # Euler: a sphere, no holes and no handles.
    assert len(found.vertices) - len(edges) // 2 + len(found.faces) == 2


def test_a_banana_is_bent_thin_and_has_three_colours() -> None:
    found = mesh_targets.banana()
    assert found.colors.shape == found.vertices.shape
    assert 0 < found.colors.min() < found.colors.max() < 1
    x, y, z = found.vertices.T
    assert np.ptp(z) < 0.35 * np.ptp(x)
    middle, ends = np.abs(x) < 0.05, np.abs(x) > 0.45
    assert y[middle].mean() + 0.1 < min(y[ends & (x < 0)].mean(), y[ends & (x > 0)].mean())
    brown = found.colors[:, 0] < 0.4
    assert np.abs(x[brown]).min() > 0.35
    green = found.colors[:, 1] > found.colors[:, 0]
    assert 0.02 < green.mean() < 0.3


def test_suzanne_is_that_of_blender_where_it_is_installed(monkeypatch) -> None:
    square = np.array(quad(0.0, 3.0, 0.0, 1.0, 0.0))
    monkeypatch.setattr(mesh_targets, "_blender", lambda: (square, TWO.numpy()))
    found = mesh_targets.suzanne()
    assert (found.name, found.source) == ("Suzanne", "bpy")
    assert np.ptp(found.vertices, axis=0) == pytest.approx([1.0, 1 / 3, 0.0])


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
    z = torch.randn(len(control), 2, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    found = losses(z.flatten(0, 1)).view(len(control), 2)
    assert trial.evaluations == 2
    # With boxes as large as the images every handle has the whole loss of the image that it was in.
    whole = TASK.loss(control.displaced(trial.start, z.transpose(0, 1) * unit))
    torch.testing.assert_close(found, whole.expand(len(control), 2), rtol=1e-4, atol=0)


@pytest.mark.parametrize("name", ["meshfit", "meshfit_color"])
def test_a_pixel_that_only_one_covers_counts_more(name) -> None:
    task = catalogue.load(name)
    trial, control = Trial(task, "x", 0), task.mesh.control(0)
    zero = torch.zeros(len(control), task.mesh.channels, dtype=torch.float64)
    unit = torch.ones(task.mesh.channels, dtype=torch.float64)
    without, found = (
        _losses(trial, control, trial.start, unit, margin=1000.0, silhouette=weight)(zero) for weight in (0.0, 0.5)
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


@pytest.mark.parametrize(
    ("method", "settings", "share"),
    [
        ("handles_adam", SHORT, 0.95),
        ("handles_newton", SHORT, 0.95),
        ("levels_adam", {**SHORT, "levels": (0,)}, 1.0),
        ("levels_newton_cg", {"levels": (0,), "steps": 1, "samples": 24}, 1.0),
        ("large_steps_adam", {"steps": 6, "samples": 4}, 1.0),
    ],
)
def test_a_few_steps_lower_the_error(method, settings, share) -> None:
    torch.manual_seed(0)
    trial = Trial(TASK, method, 1000)
    METHODS[method].solve(trial, settings)
    assert trial.evaluations == 48
    first, last = trial.rows[0], trial.rows[-1]
    assert last.image_error < share * first.image_error


def test_colors_are_fitted_with_the_vertices() -> None:
    torch.manual_seed(0)
    task = catalogue.load("meshfit_color")
    trial = Trial(task, "handles_adam", 1000)
    METHODS["handles_adam"].solve(trial, {**SHORT, "silhouette": 0.0})
    assert trial.rows[-1].image_error < 0.95 * trial.rows[0].image_error
    x = task.mesh.rows(trial.x)
    assert float((x[:, 3:] - 0.5).abs().max()) > 0.01
    # With the places kept, new colours alone change the image to the better.
    grey = x.clone()
    grey[:, 3:] = 0.5
    assert task.truth.image_error(trial.x) < task.truth.image_error(grey.flatten())
