"""The tasks that Mitsuba renders: geometry, plateaus, errors and settings, in the variant that is everywhere."""

import math
import weakref

import numpy as np
import pytest
import torch
from skimage import data

from experiments.problems import catalogue
from experiments.problems.rendered import RenderedTask
from experiments.problems.scenes import shadow as shad
from experiments.problems.scenes.bunny import IN_MIRRORS, SEEN_AT, in_mirrors
from torch_zerohess.adapters.mitsuba import MitsubaScene, Transform
from truths import vector


def photograph() -> list[float]:
    """Means of blocks of 16x16 pixels, row by row from below."""
    blocks = data.camera().reshape(32, 16, 32, 16).mean((1, 3)) / 255.0
    return blocks[::-1].flatten().tolist()


NAMES = tuple(catalogue.RENDERED)
SOLUTIONS = {"mug": [0.0], "shad": [-1.5, 1.0], "bunny": [0.0] * 3, "mirror": [0.0] * 3, "poster": photograph()}
TASKS = {name: catalogue.load(name, "fast", "scalar_rgb") for name in NAMES}


@pytest.fixture(params=NAMES)
def task(request) -> RenderedTask:
    return TASKS[request.param]


# All of them


def test_the_loss_is_zero_at_the_solution_and_far_from_it_at_the_start(task) -> None:
    solution = vector(*SOLUTIONS[task.name])
    start = task.start(0)
    at, there = task.loss(torch.stack([solution, start])).tolist()
    assert at < 1e-12
    assert there > 1e-3
    assert task.truth.image_error(solution) == pytest.approx(at)
    assert task.truth.image_error(start) == pytest.approx(there)
    assert task.truth.parameter_error(solution) < 1e-30


def test_loss_image_and_residuals_are_one(task) -> None:
    x = task.start(1)
    image = task.output.image(x[None])[0]
    width, height = task.setting.film
    assert image.shape == (height, width, 3)
    loss = float(task.loss(x[None])[0])
    assert float(task.output.loss(image)) == pytest.approx(loss)
    assert float(task.output.residuals(image).square().mean()) == pytest.approx(loss)
    target = task.output.image(vector(*SOLUTIONS[task.name])[None])[0]
    assert float((image - target).square().mean()) == pytest.approx(loss)


def test_what_is_remembered_is_what_would_be_rendered(task) -> None:
    x = task.start(2)
    task.loss(torch.stack([x, x + 0.01]))
    remembered = task.truth.image_error(x)
    fresh = catalogue.load(task.name, "fast", "scalar_rgb")
    assert fresh.truth.image_error(x) == pytest.approx(remembered, rel=1e-6)
    assert fresh.truth.image_error(x + 0.01) == pytest.approx(task.truth.image_error(x + 0.01), rel=1e-6)


def test_a_scene_that_was_released_is_loaded_again() -> None:
    task = catalogue.load("shad", "fast", "scalar_rgb")
    x = task.start(0)[None]
    before = task.output.image(x)
    scene = weakref.ref(task.output.image.__self__.scene)
    task.renderer.release()
    assert scene() is None
    assert torch.equal(task.output.image(x), before)


def test_starts_are_within_the_bounds_and_differ(task) -> None:
    starts = torch.stack([task.start(run) for run in range(200)])
    lower, upper = task.bounds
    assert bool(((starts > lower) & (starts < upper)).all())
    assert bool((lower < vector(*SOLUTIONS[task.name])).all())
    assert bool((vector(*SOLUTIONS[task.name]) < upper).all())
    assert len({tuple(x.tolist()) for x in starts}) == 200
    assert torch.equal(starts[7], task.start(7))


def test_the_full_setting_is_the_same_task_with_more_of_everything(task) -> None:
    full = catalogue.load(task.name, "paper", "scalar_rgb")
    assert full.setting.film[0] > task.setting.film[0]
    assert full.setting.spp > task.setting.spp
    assert full.setting.depth >= task.setting.depth
    assert (full.name, full.n, full.sigma) == (task.name, task.n, task.sigma)
    assert torch.equal(full.start(3), task.start(3))
    assert str(full.setting) in full.needs


def test_pictures_are_srgb(task) -> None:
    picture = task.picture.of(task.start(0))
    assert picture.shape[-1] == 3
    assert 0.0 <= float(picture.min()) < float(picture.max()) <= 1.0


@pytest.mark.parametrize("name", ["mug", "bunny", "mirror"])
def test_the_scene_for_derivatives_has_the_same_image(name) -> None:
    task = TASKS[name]
    x = task.start(4)[None]
    same = task.moving(task.setting)(x)
    torch.testing.assert_close(same.double(), task.output.image(x), rtol=0.0, atol=1e-4)


# MUG


def test_the_parameter_error_of_the_mug_has_a_period() -> None:
    error = TASKS["mug"].truth.parameter_error
    for x in (0.3, 5.0, -2.0):
        for turns in (-1, 1, 2):
            assert error(vector(x + 18 * turns)) == pytest.approx(error(vector(x)))
        assert error(vector(-x)) == pytest.approx(error(vector(x)))
    assert error(vector(18.0)) == 0.0
    assert error(vector(9.0)) == pytest.approx(81.0)


def test_the_mug_has_a_plateau_from_40_to_100_degrees_and_a_narrow_basin() -> None:
    degrees = vector(45, 55, 65, 75, 85, 95)
    plateau = TASKS["mug"].loss(degrees[:, None] / 20)
    start, middle, near = TASKS["mug"].loss(vector(190, 150, 4)[:, None] / 20).tolist()
    assert float(plateau.max() - plateau.min()) < 0.02 * float(plateau.mean())
    assert abs(start - middle) > 0.1 * float(plateau.mean())
    assert near < 0.7 * float(plateau.mean())


# SHAD


def test_the_whole_shadow_is_in_view_at_the_corners_of_the_bounds() -> None:
    half_width = shad.CAMERA * math.tan(math.radians(shad.FIELD_OF_VIEW / 2))
    (y0, z0), (y1, z1) = (side.tolist() for side in TASKS["shad"].bounds)
    for x in ((y0, z0), (y0, z1), (y1, z0), (y1, z1)):
        y, z = outline(*x)
        assert float(np.abs(y).max()) < half_width
        assert float(np.abs(z).max()) < half_width * 48 / 64


def test_a_shadow_takes_the_light_that_its_place_and_size_say() -> None:
    """What is missing, against the direct light within the outline; the sky that the ball hides comes on top."""
    task = TASKS["shad"]
    (y0, z0), (y1, z1) = (side.tolist() for side in task.bounds)
    points = torch.tensor([[y0, z0], [y0, z1], [y1, z0], [y1, z1], [-1.5, 1.0], [100.0, 100.0]]).double()
    images = task.output.image(points)[..., 0]  # red, the colour of the light
    missing = (images[-1] - images[:-1]).mean((1, 2))
    half_width = shad.CAMERA * math.tan(math.radians(shad.FIELD_OF_VIEW / 2))
    for found, point in zip(missing.tolist(), points[:-1].tolist(), strict=True):
        y, z = outline(*point)
        area = 0.5 * abs(float(np.sum(y * np.roll(z, -1) - np.roll(y, -1) * z)))
        light = np.array(shad.LIGHT) - [0.0, y.mean(), z.mean()]
        distance = float(np.linalg.norm(light))
        radiance = 0.4 / math.pi * shad.POWER * light[0] / distance**3  # mean reflectance of the pattern
        expected = radiance * area / (4 * half_width**2 * 48 / 64)
        assert 0.85 * expected < found < 1.25 * expected


def outline(y: float, z: float) -> tuple[np.ndarray, np.ndarray]:
    """Points y, z [200] of the wall x = 0 where rays from the light touch the ball."""
    light = np.array(shad.LIGHT)
    axis = np.array(shad.BALL) + np.array([0.0, y, z]) - light
    distance = np.linalg.norm(axis)
    axis /= distance
    first = np.cross(axis, [0.0, 0.0, 1.0])
    first /= np.linalg.norm(first)
    second, turn = np.cross(axis, first), np.linspace(0, 2 * math.pi, 200, endpoint=False)[:, None]
    angle = math.asin(0.5 / distance)
    rays = math.cos(angle) * axis + math.sin(angle) * (np.cos(turn) * first + np.sin(turn) * second)
    hits = light - rays * light[0] / rays[:, :1]
    return hits[:, 1], hits[:, 2]


def test_the_ball_itself_is_out_of_view() -> None:
    """Of the cone to the corners of the image, at the ball's distance, nothing comes within its radius."""
    lower, _ = TASKS["shad"].bounds
    nearest = shad.BALL[1] + float(lower[0]) - 0.5
    half_width = (shad.CAMERA - shad.BALL[0] + 0.5) * math.tan(math.radians(shad.FIELD_OF_VIEW / 2))
    assert nearest > half_width


# MIRROR


@pytest.mark.parametrize("removed", ["mirror1", "mirror2"])
def test_without_either_mirror_the_bunny_is_not_seen(removed) -> None:
    def scene(mi):
        return {name: part for name, part in in_mirrors(mi).items() if name != removed}

    task = TASKS["mirror"]
    x = torch.stack([task.solution, task.start(0), vector(1.0, 1.0, 1.0)])
    blind = MitsubaScene(scene, [IN_MIRRORS], film=(24, 24), spp=4, depth=4, variant="scalar_rgb", threads=1)(x)
    assert torch.equal(blind, blind[:1].expand(3, -1, -1, -1))
    assert len(torch.unique(task.output.image(x).round(decimals=3), dim=0)) == 3


def test_two_mirrors_show_the_bunny_as_it_is_from_farther_away() -> None:
    """Parallel mirrors that face one another move the eye: from (1.5, 0, 2.2) the way is that from (-1.2, 0, 4.9)."""
    eye = np.array([1.5, 0.0, 2.2])
    for at, normal in (([1.5, 0.0, -0.6], [-1.0, 0.0, 1.0]), ([-1.2, 0.0, -0.6], [1.0, 0.0, -1.0])):
        unit = np.array(normal) / math.sqrt(2)
        eye = eye - 2 * unit * float((eye - at) @ unit)
    np.testing.assert_allclose(eye, [-1.2, 0.0, 4.9], atol=1e-12)

    def direct(mi):
        view = mi.ScalarTransform4f().look_at(origin=eye.tolist(), target=[*SEEN_AT[:1], 0.0, 0.0], up=[0, 1, 0])
        kept = {name: part for name, part in in_mirrors(mi).items() if not name.startswith("mirror")}
        return {**kept, "sensor": {**kept["sensor"], "to_world": view}}

    x = torch.zeros(1, 3).double()
    size = {"film": (24, 24), "spp": 64, "variant": "scalar_rgb", "threads": 1}
    straight = MitsubaScene(direct, [Transform("bunny.to_world", move=IN_MIRRORS.move)], depth=2, **size)
    through = MitsubaScene(in_mirrors, [IN_MIRRORS], depth=4, **size)
    seen, mirrored = straight(x[:, :2])[0], through(x)[0]
    bunny = (seen - 0.25).abs().mean(-1) > 0.05
    assert 0.1 < float(bunny.double().mean()) < 0.9
    difference = (seen - mirrored).abs().mean(-1)
    assert float(difference.median()) < 0.02
    assert float(difference.mean()) < 0.05


# POSTER


def test_a_pixel_of_the_poster_sees_several_texels_and_a_texel_is_seen_by_several_pixels() -> None:
    image = TASKS["poster"].output.image
    black, texels = torch.zeros(1, 1024).double(), torch.arange(0, 1024, 31)
    seen = image(torch.eye(1024).double()[texels]) - image(black)
    assert int((seen[..., 0] > 0).sum((1, 2)).min()) >= 4
    checks = (torch.arange(1024) + torch.arange(1024) // 32) % 2
    for parity in (0, 1):
        one = image((checks == parity).double()[None])[0, ..., 0]
        inside = image(black + 1.0)[0, ..., 0] > 0.9
        assert float(((one > 0) & (one < 0.99))[inside].double().mean()) > 0.8


def test_a_render_of_the_poster_is_linear_in_its_texture() -> None:
    task = TASKS["poster"]
    x, y = task.start(0), task.start(1)
    one, other, between = task.output.image(torch.stack([x, y, 0.25 * x + 0.75 * y]))
    torch.testing.assert_close(between, 0.25 * one + 0.75 * other, rtol=0.0, atol=1e-5)
