"""Which sensors of a Mitsuba scene are rendered: two that each see one square, which shines."""

import math

import pytest
import torch
from small_scenes import VARIANTS, rgb

import torch_zerohess as zh
from experiments.problems.scenes import parts
from torch_zerohess.adapters.mitsuba import MitsubaScene, Transform, Value

SHINE = [Value("before.emitter.radiance.value"), Value("behind.emitter.radiance.value")]
RADIANCES = [[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]]


def camera(mi, z, film=(4, 3)):
    """At the origin, looking at a square that fills the image."""
    view = mi.ScalarTransform4f().look_at(origin=[0, 0, 0], target=[0, 0, z], up=[0, 1, 0])
    return parts.camera(view, 2 * math.degrees(math.atan(1 / 3)), film)


def room(mi):
    """A square on either side of the two sensors, without an integrator."""
    turned = mi.ScalarTransform4f().translate([0, 0, 3]).rotate([0, 1, 0], 180).scale(2)
    towards = mi.ScalarTransform4f().translate([0, 0, -3]).scale(2)
    return {
        "type": "scene",
        "forwards": camera(mi, 1),
        "backwards": camera(mi, -1),
        "before": {"type": "rectangle", "to_world": turned, "emitter": {"type": "area", "radiance": rgb(1, 2, 3)}},
        "behind": {"type": "rectangle", "to_world": towards, "emitter": {"type": "area", "radiance": rgb(4, 5, 6)}},
    }


def rig(mi):
    """Both sensors in one of Mitsuba's own kind, whose image has them side by side."""
    both = room(mi)
    film = {**both["forwards"]["film"], "width": 8}
    return {
        **{name: part for name, part in both.items() if not name.endswith("wards")},
        "alone": camera(mi, 1),
        "rig": {"type": "batch", "forwards": both["forwards"], "backwards": both["backwards"], "film": film},
    }


def scene(description=room, parameters=SHINE, **more):
    return MitsubaScene(
        description, parameters, **{"spp": 1, "depth": 2, "variant": "scalar_rgb", "threads": 1, **more}
    )


X = torch.tensor([RADIANCES, [[0.5, 0.4, 0.3], [0.2, 0.1, 0.0]]])
"""Two points: the radiance of the square before and of the one behind."""


@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize(
    ("sensor", "views"),
    [
        ("forwards", 0),
        ("backwards", 1),
        (0, 0),
        (1, 1),
        (["forwards", "backwards"], [0, 1]),
        ((1, "forwards"), [1, 0]),
        (["backwards"], [1]),
    ],
)
def test_the_views_are_those_of_the_sensors(sensor, views, variant) -> None:
    seen = X[:, views]
    expected = seen[..., None, None, :].expand(*seen.shape[:-1], 3, 4, 3)
    torch.testing.assert_close(scene(sensor=sensor, variant=variant)(X.flatten(1)), expected)


def test_without_a_choice_it_is_the_first() -> None:
    torch.testing.assert_close(scene()(X.flatten(1)), scene(sensor=0)(X.flatten(1)), rtol=0, atol=0)


def test_films_of_several_sizes() -> None:
    def uneven(mi):
        return {**room(mi), "backwards": camera(mi, -1, (6, 3))}

    message = r"films .* one size, got \(width, height\) 'forwards': \(4, 3\), 1: \(6, 3\): give film="
    with pytest.raises(ValueError, match=message):
        scene(uneven, sensor=["forwards", 1])
    both = scene(uneven, sensor=["forwards", 1], film=(5, 2))
    assert both(X.flatten(1)).shape == (2, 2, 2, 5, 3)
    assert "film=(5, 2)" in repr(both)
    assert "film=(6, 3)" in repr(scene(uneven, sensor=1))


@pytest.mark.parametrize(
    ("sensor", "error", "message"),
    [
        ("sideways", ValueError, r"sensor must be one of 0 \('forwards'\), 1 \('backwards'\), got 'sideways'"),
        (2, ValueError, r"one of 0 \('forwards'\), 1 \('backwards'\), got 2"),
        ([0, -1], ValueError, "got -1"),
        ([], ValueError, r"at least one, got \[\]"),
        ([0, "forwards"], ValueError, "must be different sensors"),
        (1.0, TypeError, "a name, a number, or a list of these, got 1.0"),
        (True, TypeError, "got True"),
    ],
)
def test_sensors_that_are_not_there(sensor, error, message) -> None:
    with pytest.raises(error, match=message):
        scene(sensor=sensor)


def test_a_parameter_of_a_sensor_that_is_not_rendered() -> None:
    move = Transform("backwards.to_world", move=((0, 0, 1),))
    with pytest.raises(ValueError, match=r"backwards.to_world is .* not rendered; sensor renders 0 \('forwards'\)$"):
        scene(parameters=[move])
    for sensor in ("backwards", ["forwards", "backwards"]):
        assert scene(parameters=[move], sensor=sensor).n == 1


def test_a_batch_of_sensors_is_one_sensor() -> None:
    move = Transform("rig.backwards.to_world", move=((0, 0, 1),))
    assert scene(rig, [move], sensor="rig").n == 1
    with pytest.raises(ValueError, match=r"sensor renders 0 \('alone'\)"):
        scene(rig, [move])
    image = scene(rig, sensor="rig")(X.flatten(1))
    torch.testing.assert_close(image[:, :, :4], scene(sensor=0)(X.flatten(1)))
    torch.testing.assert_close(image[:, :, 4:], scene(sensor=1)(X.flatten(1)))


def test_each_view_has_noise_of_its_own() -> None:
    """Two equal sensors before a matt square, with one sample of the light for each pixel."""

    def matt(mi):
        eye = camera(mi, 1)
        turned = mi.ScalarTransform4f().translate([0, 0, 3]).rotate([0, 1, 0], 180).scale(2)
        return {"type": "scene", "a": eye, "b": eye, "wall": {"type": "rectangle", "to_world": turned}, **sky}

    sky = {"sky": {"type": "constant"}}
    wall = [Value("wall.bsdf.reflectance.value", elements=1)]
    x = torch.tensor([[0.5]])
    both = scene(matt, wall, sensor=["a", "b"])(x)[0]
    torch.testing.assert_close(both[0], scene(matt, wall)(x)[0], rtol=0, atol=0)
    assert float((both[0] - both[1]).abs().min()) > 0.0


def test_views_of_a_loss_are_fitted_together() -> None:
    """The square behind is seen by the second view alone."""
    target = scene(sensor=[0, 1])(X[:1].flatten(1))[0]

    def loss(views):
        assert views.shape == (2, 3, 4, 3)
        return (views - target).square().mean()

    start, settings = torch.ones(6), {"sigma": 2.0, "seed": 0, "max_evaluations": 60, "target": 1e-6}
    found = zh.minimize(scene(sensor=[0, 1]), start, loss=loss, **settings)
    torch.testing.assert_close(found.x, X[0].flatten(), atol=1e-2, rtol=0)
    within = scene(sensor=[0, 1], loss=loss)(X.flatten(1))
    assert within.shape == (2,)
    assert float(within[0]) == 0.0


def test_a_scene_without_an_integrator_or_a_sensor_is_refused_when_it_is_made() -> None:
    with pytest.raises(RuntimeError, match=r"no integrator: give depth=.* or integrator="):
        scene(depth=None)
    assert scene(depth=None, integrator={"type": "path"}).n == 6

    def blind(mi):
        return {name: part for name, part in room(mi).items() if not name.endswith("wards")}

    with pytest.raises(RuntimeError, match="no sensor"):
        scene(blind)
