"""The mug: what its image may and may not depend on, rendered small."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch

from experiments.problems.scenes.mug import DEGREES, RADIUS, body, handle, mug_scene
from experiments.problems.srgb import to_srgb

HIDDEN = [50.0, 60.0, 70.0, 80.0, 90.0]
FACING = 257.0


class Mug:
    """Renders [K, h, w, 3] of angles [K] in degrees."""

    def __init__(self, film: tuple[int, int] = (32, 32), spp: int = 4, **more: Any) -> None:
        self.scene = mug_scene(film=film, spp=spp, threads=1, **more)

    def render(self, angles: list[float]) -> np.ndarray:
        return self.scene(torch.tensor(angles, dtype=torch.float64)[:, None] / DEGREES).numpy()


@pytest.fixture(scope="module")
def scene() -> Mug:
    return Mug()


def mse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.mean((a.astype(np.float64) - b) ** 2))


def test_shape_type_and_range(scene: Mug) -> None:
    images = scene.render([180.0, FACING])
    assert images.shape == (2, 32, 32, 3)
    assert images.dtype == np.float32
    assert np.isfinite(images).all()
    assert images.min() >= 0.0
    assert 0.1 < images.mean() < 0.8


def test_same_seed_same_bits_and_other_seed_other_noise(scene: Mug) -> None:
    first = scene.render([200.0, 250.0, 200.0])
    assert np.array_equal(first[0], first[2])
    assert np.array_equal(first, Mug().render([200.0, 250.0, 200.0]))
    assert mse(first[0], Mug(seed=1).render([200.0])[0]) > 0.0


def test_period_is_a_turn(scene: Mug) -> None:
    images = scene.render([200.0, 560.0, -160.0])
    assert mse(images[0], images[1]) < 1e-5
    assert mse(images[0], images[2]) < 1e-5


def test_body_does_not_move(scene: Mug) -> None:
    """The left half of the body is the same bits while the handle goes round on the right (0) and behind (70)."""
    images = scene.render([0.0, 70.0, 330.0])
    column = slice(12, 17)  # inside the body, left of its middle
    rows = slice(9, 22)
    assert np.array_equal(images[0, rows, column], images[1, rows, column])
    assert np.array_equal(images[0, rows, column], images[2, rows, column])


def test_rotation_is_visible_and_the_loss_has_its_minimum_at_the_target(scene: Mug) -> None:
    angles = np.arange(180.0, 311.0, 10.0)
    images = scene.render(angles.tolist())
    losses = [mse(image, images[7]) for image in images]
    assert int(np.argmin(losses)) == 7
    assert min(losses[:7] + losses[8:]) > 1e-4
    assert losses[0] > losses[6]
    assert losses[-1] > losses[8]


def test_hidden_handle_is_a_plateau(scene: Mug) -> None:
    hidden, visible = scene.render(HIDDEN), scene.render([FACING])[0]
    change = max(mse(image, hidden[0]) for image in hidden)
    assert change < 0.02 * mse(visible, hidden[0])


def test_scalar_variant_shows_the_same_mug() -> None:
    """Two samplers, one scene: block means over 8x8 pixels agree to a few per cent."""
    image = Mug(spp=32).render([220.0])[0]
    other = Mug(spp=32, variant="scalar_rgb").render([220.0])[0]
    blocks = [x.reshape(4, 8, 4, 8, 3).mean((1, 3)) for x in (image, other)]
    np.testing.assert_allclose(blocks[0], blocks[1], rtol=0.1)


def test_film_may_be_wide() -> None:
    assert Mug(film=(16, 12), spp=1).render([0.0]).shape == (1, 12, 16, 3)


@pytest.mark.parametrize("surface", [body, handle])
def test_normals_are_unit_and_agree_with_the_triangles(surface: Callable[[], Any]) -> None:
    vertices, normals, faces = surface()
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    assert (np.sum(np.cross(b - a, c - a) * normals[faces].sum(1), axis=1) > 0.0).all()


def test_handle_ends_are_inside_the_wall() -> None:
    vertices = handle()[0].reshape(13, 33, 3)
    ends = np.linalg.norm(vertices[:, [0, -1]][..., [0, 2]], axis=-1)
    assert (ends < RADIUS).all()
    assert (ends > RADIUS - 0.0036).all()


def test_direct_light_is_the_least_depth() -> None:
    with pytest.raises(ValueError, match="depth must be at least 2"):
        mug_scene(depth=1)


def test_srgb_of_known_values() -> None:
    assert to_srgb([0.0, 0.0031308, 0.18, 0.5, 1.0, 7.0]).tolist() == [0, 10, 118, 188, 255, 255]
