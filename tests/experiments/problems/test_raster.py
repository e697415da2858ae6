"""The rasteriser against closed forms and a loop over rays."""

import math

import numpy as np
import pytest
import torch
from quads import TWO, quad

from experiments.problems import catalogue
from experiments.problems.scenes.icosphere import icosphere
from experiments.problems.scenes.raster import AMBIENT, LAMP, Cameras, render

TASK = catalogue.load("meshfit")
FRONT = Cameras(torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64), side=64, extent=1.0)
LIGHT = np.array(LAMP) / np.linalg.norm(LAMP)


def lambert(normal) -> float:
    return AMBIENT + (1 - AMBIENT) * max(0.0, float(np.dot(normal, LIGHT)))


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
