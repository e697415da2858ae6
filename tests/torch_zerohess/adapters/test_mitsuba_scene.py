"""Mitsuba scenes as black boxes: small scenes whose images are known in closed form, in every variant that works."""

import concurrent.futures
import contextlib
import copy
import gc
import math
import pickle
import threading
from pathlib import Path
from unittest.mock import patch

import numpy as np
import pytest
import torch
from small_scenes import RADIANCE, REFLECTANCE, VARIANTS, WITHOUT_NOISE, camera, lamp, plane, rgb, screen

import torch_zerohess as zh
from experiments.problems.scenes.parts import mi_mesh
from torch_zerohess.adapters.mitsuba import MitsubaScene, Transform, Value
from torch_zerohess.evaluators import Executor, Factory, Inline, ProcessPool


def things(mi):
    """Two spheres that are turned and moved, and a triangle."""
    first = mi.ScalarTransform4f().translate([1, 2, 3]).rotate([1, 0, 0], 30)
    second = mi.ScalarTransform4f().translate([-1, 0, 0]).scale(0.5)
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 1.0]])
    normals = np.tile([[0.0, -(0.2**0.5), 0.8**0.5]], (3, 1))
    surface = vertices, normals, np.array([[0, 1, 2]], np.uint32)
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": camera(mi),
        "ball": {"type": "sphere", "to_world": first},
        "bead": {"type": "sphere", "to_world": second},
        "triangle": mi_mesh(mi, "triangle", surface, {"type": "diffuse"}),
        "sky": {"type": "constant"},
    }


POSITIONS, NORMALS = "triangle.vertex_positions", "triangle.vertex_normals"


def shaded(mi):
    """The triangle of `things` with normals along z, which is not perpendicular to its plane."""
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 1.0]])
    surface = vertices, np.tile([[0.0, 0.0, 1.0]], (3, 1)), np.array([[0, 1, 2]], np.uint32)
    return {**things(mi), "triangle": mi_mesh(mi, "triangle", surface, {"type": "diffuse"})}


def triangle_normals(scene):
    """Those that the next render has."""
    return np.array(scene.mi.traverse(scene.scene)[NORMALS], float).reshape(3, 3)


@pytest.fixture(params=VARIANTS)
def variant(request) -> str:
    return request.param


def scalar(description, parameters, **more):
    more = {"spp": 1, "variant": "scalar_rgb", "threads": 1, **more}
    return MitsubaScene(description, parameters, **more)


def matrix(kind, vector, degrees=0.0):
    """4x4 of a translation or, by Rodrigues' formula, of a rotation."""
    out = np.eye(4)
    if kind == "move":
        out[:3, 3] = vector
        return out
    x, y, z = np.array(vector, float) / np.linalg.norm(vector)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    out[:3, :3] = np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    return out


# Poses


def test_pose_is_the_product_of_its_parts(variant) -> None:
    pose = Transform(
        ("ball.to_world", "bead.to_world"),
        move=((1, 0, 0), (0, 1, 1)),
        turn=(np.array([0.0, 0.0, 1.0]), (1, 1, 0)),
        unit=(2.0, 0.5, 90.0, 10.0),
        pivot=(0.5, -1.0, 0.0),
    )
    scene = MitsubaScene(things, [pose], variant=variant, threads=1)
    base = {name: np.array(scene.values[name].matrix, float).reshape(4, 4) for name in pose.names}
    np.testing.assert_allclose(
        base["ball.to_world"], matrix("move", [1, 2, 3]) @ matrix("turn", [1, 0, 0], 30), atol=1e-6
    )
    for x in ([0.0, 0.0, 0.0, 0.0], [0.3, -2.0, 1.5, 4.0]):
        scene.set(torch.tensor(x).double())
        away, back = matrix("move", [0.5, -1, 0]), matrix("move", [-0.5, 1, 0])
        turns = matrix("turn", [0, 0, 1], 90 * x[2]) @ matrix("turn", [1, 1, 0], 10 * x[3])
        whole = matrix("move", [2 * x[0], 0.5 * x[1], 0.5 * x[1]]) @ away @ turns @ back
        for name in pose.names:
            now = np.array(scene.values[name].matrix, float).reshape(4, 4)
            np.testing.assert_allclose(now, whole @ base[name], atol=1e-5)


def test_turns_leave_the_origin_of_the_object_where_it_is(variant) -> None:
    scene = MitsubaScene(things, [Transform("ball.to_world", turn=((0, 1, 0),), unit=90.0)], variant=variant, threads=1)
    scene.set(torch.tensor([0.7]).double())
    now = np.array(scene.values["ball.to_world"].matrix, float).reshape(4, 4)
    expected = matrix("move", [1, 2, 3]) @ matrix("turn", [0, 1, 0], 63) @ matrix("turn", [1, 0, 0], 30)
    np.testing.assert_allclose(now, expected, atol=1e-5)


def test_vertices_move_and_turn_and_normals_turn(variant) -> None:
    pose = Transform("triangle.vertex_positions", move=((1, 0, 0),), turn=((0, 0, 1),), unit=(1.0, 90.0))
    scene = MitsubaScene(things, [pose], variant=variant, threads=1)
    names = "triangle.vertex_positions", "triangle.vertex_normals"
    before = [np.array(scene.values[name], float).reshape(3, 3) for name in names]
    scene.set(torch.tensor([3.0, 1.0]).double())
    vertices, normals = (np.array(scene.values[name], float).reshape(3, 3) for name in names)
    turn = matrix("turn", [0, 0, 1], 90)[:3, :3]
    centre = np.array([0.5, 1.0, 0.5])  # of the box from (0, 0, 0) to (1, 2, 1)
    np.testing.assert_allclose(vertices, (before[0] - centre) @ turn.T + centre + [3, 0, 0], atol=1e-6)
    np.testing.assert_allclose(normals, before[1] @ turn.T, atol=1e-6)


@pytest.mark.parametrize("parameters", [[Transform(POSITIONS, move=((1, 0, 0),))], [Value(POSITIONS), Value(NORMALS)]])
def test_normals_that_are_given_stay(variant, parameters) -> None:
    """Wherever the vertices were before: to a scalar variant equal normals are no change."""
    scene = MitsubaScene(shaded, parameters, variant=variant, threads=1)
    for step in (0.0, 1.0, 2.0, 0.0):
        x = scene.x0.clone()
        x[0] += step
        scene.set(x)
        np.testing.assert_allclose(triangle_normals(scene), [[0, 0, 1]] * 3, atol=1e-6)


@pytest.mark.parametrize("order", [1, -1])
def test_normals_that_follow_a_transform_are_not_given(order) -> None:
    """The transform would write over them."""
    both = [Value(NORMALS), Transform(POSITIONS, move=((1, 0, 0),))]
    with pytest.raises(ValueError, match=f"must not change the same value twice, got {NORMALS} more than once"):
        scalar(shaded, both[::order])


def test_a_mesh_without_normals_moves(variant, tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")

    def flat(mi):
        mesh = {"type": "obj", "filename": str(tmp_path / "flat.obj"), "face_normals": True}
        return {"type": "scene", "sensor": camera(mi), "triangle": mesh}

    scene = MitsubaScene(flat, [Transform(POSITIONS, move=((1, 2, 3),))], depth=2, variant=variant, threads=1)
    scene.set(torch.ones(1).double())
    vertices = np.array(scene.values[POSITIONS], float).reshape(3, 3)
    np.testing.assert_allclose(vertices, [[1, 2, 3], [2, 2, 3], [1, 3, 3]], atol=1e-6)


def test_labels_bounds_and_start() -> None:
    pose = Transform("ball.to_world", move=((1, 0, 0),), turn=((0, 1, 0),), bounds=((-2, 3), (-1, 1)))
    scene = scalar(things, [pose, Transform("bead.to_world", move=((0, 1, 0),))])
    assert scene.n == 3
    assert scene.labels == ["ball.to_world.move0", "ball.to_world.turn0", "bead.to_world.move0"]
    assert scene.x0.tolist() == [0, 0, 0]
    assert [side.tolist() for side in scene.bounds] == [[-2, -1, -math.inf], [3, 1, math.inf]]


@pytest.mark.parametrize("kind", [np.array, torch.tensor, lambda rows: [np.array(one) for one in rows]])
def test_arrays_and_tensors_are_taken_as_lists_are(kind) -> None:
    move, turn, unit = [[1.0, 0.0, 2.0]], [[0.0, 1.0, 0.0]], [2.0, 90.0]
    bounds, pivot = [[-1.0, 3.0], [-2.0, 1.0]], [0.5, -1.0, 0.0]
    arguments = [move, turn, unit, bounds, pivot]
    scenes = [scalar(things, [Transform("ball.to_world", *map(one, arguments))]) for one in (list, kind)]
    for scene in scenes:
        assert [side.tolist() for side in scene.bounds] == [[-1, -2], [3, 1]]
        scene.set(torch.tensor([0.3, 0.7]).double())
    first, second = (np.array(one.values["ball.to_world"].matrix) for one in scenes)
    np.testing.assert_array_equal(first, second)


def test_arrays_and_tensors_for_all_columns() -> None:
    """One unit and one pair for all, and the bounds of a value."""
    pair, moves = torch.tensor([-1.0, 2.0]), np.eye(3)[:2]
    scene = scalar(things, [Transform("ball.to_world", moves, unit=np.array(2.0), bounds=pair)])
    assert [side.tolist() for side in scene.bounds] == [[-1, -1], [2, 2]]
    scene = scalar(plane, [Value(REFLECTANCE, unit=torch.tensor(0.5), bounds=np.array([0.5, 1.5]))])
    assert [side.tolist() for side in scene.bounds] == [[0.5] * 3, [1.5] * 3]
    torch.testing.assert_close(scene.x0, torch.ones(3).double())


# Values


def test_radiance_is_what_is_seen(variant) -> None:
    scene = MitsubaScene(lamp, [Value(RADIANCE)], spp=2, variant=variant, threads=1)
    assert scene.labels == [f"{RADIANCE}[{i}]" for i in range(3)]
    torch.testing.assert_close(scene.x0, torch.tensor([0.2, 0.3, 0.4]).double())
    assert scene.bounds[0].tolist() == [0, 0, 0]
    x = torch.tensor([[0.1, 2.0, 30.0], [7.0, 0.0, 0.5]]).double()
    images = scene(x)
    assert images.dtype == torch.float32
    torch.testing.assert_close(images, x.float()[:, None, None].expand(2, 4, 4, 3))


def test_reflected_light_is_albedo_times_radiance(variant) -> None:
    grey = Value(REFLECTANCE, elements=1)
    scene = MitsubaScene(plane, [grey], spp=2, integrator=WITHOUT_NOISE, variant=variant, threads=1)
    assert (scene.n, scene.labels) == (1, [REFLECTANCE])
    albedo = torch.tensor([[0.0], [0.25], [1.0]])
    expected = albedo[:, :, None, None] * torch.tensor([0.5, 1.0, 2.0])
    torch.testing.assert_close(scene(albedo), expected.expand(3, 4, 4, 3), atol=1e-5, rtol=1e-5)


def test_points_beyond_the_bounds_are_rendered_at_the_bounds() -> None:
    scene = scalar(plane, [Value(REFLECTANCE, bounds=(0.2, 0.7))], integrator=WITHOUT_NOISE)
    beyond, at = torch.tensor([[-3.0, 0.5, 9.0]]), torch.tensor([[0.2, 0.5, 0.7]])
    assert torch.equal(scene(beyond), scene(at))
    scene.set(beyond[0])
    np.testing.assert_allclose(np.array(scene.values[REFLECTANCE]).ravel(), at[0], rtol=1e-6)


def test_unit_scales_a_value() -> None:
    scene = scalar(plane, [Value(REFLECTANCE, unit=0.01)], integrator=WITHOUT_NOISE)
    torch.testing.assert_close(scene.x0, torch.full((3,), 50.0).double())
    assert [side.tolist() for side in scene.bounds] == [[0] * 3, [100] * 3]
    image = scene(torch.tensor([[10.0, 20.0, 30.0]]))[0, 0, 0]
    torch.testing.assert_close(image, torch.tensor([0.1 * 0.5, 0.2, 0.3 * 2]), atol=1e-5, rtol=1e-5)


def test_elements_of_a_texture_are_where_they_belong(variant) -> None:
    """Row by row from below, each from the left, colours last."""
    scene = MitsubaScene(screen, [Value("screen.emitter.radiance.data")], spp=4, variant=variant, threads=1)
    assert scene.n == 12
    x = torch.arange(12).double()
    image = scene(x[None])[0].double()
    expected = x.reshape(2, 2, 3).flip(0).repeat_interleave(2, 0).repeat_interleave(2, 1)
    torch.testing.assert_close(image, expected, atol=1e-4, rtol=1e-5)


def test_normals_depend_on_the_vertices_that_are_given(variant) -> None:
    """Also at the start, where a scalar variant sees no change: those of the plane of (1, 0, 0) and (0, 2, 1)."""
    scene = MitsubaScene(shaded, [Value(POSITIONS)], variant=variant, threads=1)
    for step in (0.0, 1.0, 0.0):
        scene.set(scene.x0 + step)
        np.testing.assert_allclose(triangle_normals(scene), [[0, -(0.2**0.5), 0.8**0.5]] * 3, atol=1e-6)


def test_textures_of_few_bits() -> None:
    def painted(**form):
        def scene(mi):
            picture = mi.Bitmap(np.tile(np.array([0, 51, 255], np.uint8), (2, 2, 1)))
            texture = {"type": "bitmap", "bitmap": picture, "raw": True, **form}
            return {**plane(mi), "plane": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}}}

        return scene

    values = [Value("plane.bsdf.reflectance.data")]
    with pytest.raises(ValueError, match='data is a TensorXu8: describe the bitmap with "format": "variant"'):
        scalar(painted(), values)
    scene = scalar(painted(format="variant"), values)
    torch.testing.assert_close(scene.x0.float(), torch.tensor([0.0, 0.2, 1.0]).repeat(4))


@pytest.mark.parametrize("name", ["ball (1)", "ball+", "ball[0]", "b|a", "b*", r"b\d"])
def test_names_are_no_patterns(name) -> None:
    def scene(mi):
        return {"type": "scene", "sensor": camera(mi), name: {"type": "sphere"}, "ball": {"type": "sphere"}}

    pose = f"{name}.to_world"
    found = scalar(scene, [Transform(pose, move=((1, 0, 0),))], depth=2)
    assert list(found.values.keys()) == [pose]
    found.set(torch.ones(1).double())
    np.testing.assert_allclose(np.array(found.values[pose].matrix, float).reshape(4, 4)[0, 3], 1.0)


def test_several_names_share_a_value() -> None:
    def two(mi):
        return {**plane(mi), "lid": {"type": "disk", "bsdf": {"type": "diffuse", "reflectance": rgb(0.1, 0.1, 0.1)}}}

    scene = scalar(two, [Value((REFLECTANCE, "lid.bsdf.reflectance.value"))], integrator=WITHOUT_NOISE)
    scene.set(torch.tensor([0.3, 0.4, 0.6]).double())
    for name in (REFLECTANCE, "lid.bsdf.reflectance.value"):
        np.testing.assert_allclose(np.array(scene.values[name]).ravel(), [0.3, 0.4, 0.6], rtol=1e-6)


# Noise, loss, loading


def test_noise_is_the_same_in_all_renders_in_a_call_or_in_none(variant) -> None:
    x = torch.full((2, 3), 0.5)
    integrator = {"type": "path", "max_depth": 2}
    scenes = {
        noise: MitsubaScene(
            plane, [Value(REFLECTANCE)], spp=1, integrator=integrator, noise=noise, variant=variant, threads=1
        )
        for noise in ("fixed", "call", "point")
    }
    fixed, call, point = (torch.cat([scene(x), scene(x)]) for scene in scenes.values())
    assert torch.equal(fixed, fixed[:1].expand(4, -1, -1, -1))
    assert torch.equal(call[0], call[1])
    assert torch.equal(call[2], call[3])
    assert not torch.equal(call[0], call[2])
    assert len({tuple(one.flatten().tolist()) for one in point}) == 4


@pytest.mark.usefixtures("quick_workers")
def test_workers_do_not_repeat_the_noise_of_each_other() -> None:
    """The first renders of two workers and of this process, of 48 noisy values each; fixed noise is the same in all."""
    x = torch.full((1, 3), 0.5)
    with ProcessPool(1) as first, ProcessPool(1) as second:
        for noise, count in (("point", 6), ("call", 6), ("fixed", 1)):
            fn = Factory(scalar, plane, [Value(REFLECTANCE)], integrator={"type": "path", "max_depth": 2}, noise=noise)
            images = [evaluator(fn, x) for evaluator in (Inline(), first, second) for _ in range(2)]
            assert len({tuple(one.flatten().tolist()) for one in images}) == count
            assert torch.equal(images[0], scalar(*fn.args, **fn.kwargs)(x))


@pytest.mark.parametrize("integer", [np.int64, torch.tensor])
def test_integers_may_be_those_of_others(variant, integer) -> None:
    numbers = {"spp": 2, "depth": 2, "seed": 3, "threads": 1}
    settings = {name: integer(number) for name, number in numbers.items()}
    scenes = [MitsubaScene(lamp, [Value(RADIANCE)], variant=variant, **given) for given in (settings, numbers)]
    assert torch.equal(*(scene(scene.x0[None]) for scene in scenes))


def test_seed_changes_the_noise_and_nothing_else() -> None:
    def image(seed):
        scene = scalar(plane, [Value(REFLECTANCE)], spp=64, seed=seed, integrator={"type": "path", "max_depth": 2})
        return scene(torch.full((1, 3), 0.5))[0]

    first, again, other = image(0), image(0), image(1)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    expected = 0.5 * torch.tensor([0.5, 1.0, 2.0])
    torch.testing.assert_close(first.mean((0, 1)), expected, rtol=0.1, atol=0.0)
    torch.testing.assert_close(other.mean((0, 1)), expected, rtol=0.1, atol=0.0)


def test_loss_inside_is_the_loss_of_the_image() -> None:
    def loss(image):
        return (image - 0.25).square().mean()

    x = torch.tensor([[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]]).double()
    images = scalar(lamp, [Value(RADIANCE)])(x)
    losses = scalar(lamp, [Value(RADIANCE)], loss=loss)(x)
    assert losses.shape == (2,)
    assert losses.dtype == x.dtype
    torch.testing.assert_close(losses, torch.stack([loss(one) for one in images]).double())
    with pytest.raises(ValueError, match="one number per image"):
        scalar(lamp, [Value(RADIANCE)], loss=lambda image: image[0])(x)
    for number in float, np.float32:  # as scikit-image and plain Python compute it
        found = scalar(lamp, [Value(RADIANCE)], loss=lambda image, number=number: number(loss(image)))(x)
        torch.testing.assert_close(found, losses)


def test_a_scene_is_loaded_once(variant) -> None:
    scene = MitsubaScene(lamp, [Value(RADIANCE)], spp=1, variant=variant, threads=1)
    with patch.object(scene.mi, "load_dict", side_effect=AssertionError("loaded again")):
        for _ in range(5):
            scene(torch.rand(3, 3))


def test_film_depth_and_xml(tmp_path: Path) -> None:
    path = tmp_path / "lamp.xml"
    path.write_text(
        """<scene version="3.0.0">
        <integrator type="path"/>
        <sensor type="perspective"><film type="hdrfilm"><string name="pixel_format" value="rgb"/></film></sensor>
        <emitter type="constant" id="sky"><rgb name="radiance" value="0.1, 0.2, 0.3"/></emitter>
        </scene>"""
    )
    scene = scalar(path, [Value("sky.radiance.value")], film=(5, 3), depth=2)
    image = scene(torch.tensor([[1.0, 2.0, 3.0]]))
    torch.testing.assert_close(image, torch.tensor([1.0, 2.0, 3.0]).expand(1, 3, 5, 3))


# Inside the library


def test_black_box_has_the_gradient_and_hessian_of_a_quadratic() -> None:
    scene = scalar(lamp, [Value(RADIANCE, elements=1)], loss=lambda image: (image.double() - 0.5).square().mean())
    x = torch.tensor([2.0]).double()
    estimate = zh.estimate(scene, x, zh.Smoothing(sigma=0.1, samples=32, seed=0))
    for value, name, truth in ((estimate.gradient, "gradient", 3.0), (estimate.hessian(), "hessian_diagonal", 2.0)):
        deviation = float(abs(value.squeeze() - truth))
        assert deviation < 5 * float(estimate.standard_error(name).squeeze()) + 1e-3
    layer = zh.BlackBox(scalar(lamp, [Value(RADIANCE)]), zh.Smoothing(sigma=0.1, samples=64, seed=0))
    x = torch.tensor([1.0, 2.0, 3.0], requires_grad=True)
    assert layer(x).shape == (4, 4, 3)
    layer(x)[0, 0, 0].backward()
    assert x.grad is not None
    torch.testing.assert_close(x.grad, torch.tensor([1.0, 0.0, 0.0]), atol=0.5, rtol=0.0)


def test_minimize_finds_the_radiance() -> None:
    scene = scalar(lamp, [Value(RADIANCE)])
    target = torch.tensor([1.5, 0.5, 1.0])
    fit = zh.minimize(
        scene,
        scene.x0,
        sigma=0.5,
        bounds=scene.bounds,
        loss=lambda image: (image - target).square().mean(),
        max_evaluations=200,
    )
    torch.testing.assert_close(fit.x.float(), target, atol=1e-3, rtol=0.0)


def test_scenes_of_two_variants_live_together() -> None:
    x = torch.tensor([[0.2, 0.5, 0.7]])
    scenes = [MitsubaScene(lamp, [Value(RADIANCE)], spp=1, variant=name, threads=1) for name in VARIANTS]
    for scene in scenes * 2:
        assert scene(x)[0, 2, 2].tolist() == pytest.approx(x[0].tolist(), rel=1e-5)
        scene.mi.set_variant("scalar_spectral")  # as other code of the process may


def test_threads_take_turns_with_a_scene() -> None:
    """A renderer that lets another thread in, if that one can come, returns the radiance that it then finds."""
    scene = scalar(lamp, [Value(RADIANCE)], noise="point")
    meeting, seeds = threading.Barrier(2), []

    def render(_, seed, **more):
        seeds.append(seed)
        with contextlib.suppress(threading.BrokenBarrierError):
            meeting.wait(0.2)
        return np.broadcast_to(np.array(scene.values[RADIANCE]).reshape(-1), (4, 4, 3))

    x = torch.rand(8, 3, generator=torch.Generator().manual_seed(0))
    with patch.object(scene.mi, "render", render), concurrent.futures.ThreadPoolExecutor(2) as threads:
        images = Executor(threads)(scene, x)
    torch.testing.assert_close(images, x[:, None, None].expand(8, 4, 4, 3))
    assert sorted(seeds) == list(range(1, 9))


def test_the_points_of_a_call_share_their_noise_whatever_other_threads_call() -> None:
    scene = scalar(lamp, [Value(RADIANCE)], noise="call")
    seeds: dict[str, list[int]] = {"first": [], "other": []}
    other = threading.Thread(target=lambda: scene(torch.zeros(1, 3)), name="other")

    def render(_, seed, **more):
        own = seeds["other" if threading.current_thread() is other else "first"]
        own.append(seed)
        if own is seeds["first"] and len(own) == 1:
            other.start()
            other.join(0.2)
        return np.zeros((4, 4, 3))

    with patch.object(scene.mi, "render", render):
        scene(torch.zeros(2, 3))
        other.join()
    assert seeds == {"first": [1, 1], "other": [2]}


def test_a_deep_copy_shares_the_scene_and_counts_its_own_calls() -> None:
    weights = torch.nn.Linear(3, 1)
    scene = scalar(plane, [Value(REFLECTANCE)], noise="point", depth=2)
    scene.loss = torch.nn.Sequential(
        weights, torch.nn.Flatten(0), torch.nn.Unflatten(0, (1, 16)), torch.nn.AvgPool1d(16)
    )
    x = torch.full((1, 3), 0.5)
    scene(x)
    other = copy.deepcopy(scene)
    assert other.scene is scene.scene
    first, second = scene(x), scene(x)
    assert not torch.equal(first, second)
    assert torch.equal(torch.cat([other(x), other(x)]), torch.cat([first, second]))
    with torch.no_grad():
        weights.weight.zero_()
        weights.bias.fill_(7.0)
    assert float(scene(x)) == 7.0
    assert float(other(x)) != 7.0
    other.x0.zero_()
    assert bool((scene.x0 == 0.5).all())


def test_a_scene_that_is_pickled_names_the_factory() -> None:
    scene = scalar(lamp, [Value(RADIANCE)])
    with pytest.raises(TypeError, match=r"a MitsubaScene cannot be pickled: pass evaluators\.Factory\(MitsubaScene"):
        pickle.dumps(scene)
    assert copy.copy(scene).scene is scene.scene


def test_the_average_of_a_model_with_a_scene() -> None:
    """Its images are those of its own network: the mean of the weights, whichever model was called last."""
    scene = scalar(lamp, [Value(RADIANCE)])
    model = torch.nn.Sequential(torch.nn.Linear(1, 3), zh.BlackBox(scene, zh.Smoothing(sigma=0.1)))
    average = torch.optim.swa_utils.AveragedModel(model)
    for bias in (1.0, 2.0):
        torch.nn.init.constant_(model[0].bias, bias)
        average.update_parameters(model)
    zero = torch.zeros(1, 1)
    for expected, one in ((2.0, model), (1.5, average), (2.0, model)):
        torch.testing.assert_close(one(zero), torch.full((1, 4, 4, 3), expected))


def test_copies_take_turns() -> None:
    scene = scalar(lamp, [Value(RADIANCE)])
    both, meeting = (scene, copy.deepcopy(scene)), threading.Barrier(2)

    def render(*_, **more):
        with contextlib.suppress(threading.BrokenBarrierError):
            meeting.wait(0.2)
        return np.broadcast_to(np.array(scene.values[RADIANCE]).reshape(-1), (4, 4, 3))

    x = torch.tensor([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    with patch.object(scene.mi, "render", render), concurrent.futures.ThreadPoolExecutor(2) as threads:
        images = torch.cat([*threads.map(lambda one, point: one(point[None]), both, x)])
    torch.testing.assert_close(images, x[:, None, None].expand(2, 4, 4, 3))


def test_start_is_within_the_bounds() -> None:
    """Also where the value of the scene is not, or not after its rounding to float32."""

    def rough(mi):
        return {**plane(mi), "plane": {"type": "rectangle", "bsdf": {"type": "roughconductor", "alpha": 1e-4}}}

    for scene in (
        scalar(plane, [Value(REFLECTANCE, bounds=(0, 0.1))], depth=2),
        scalar(rough, [Value("plane.bsdf.alpha.value", elements=1)], depth=2),
    ):
        assert bool((scene.x0 >= scene.bounds[0]).all() and (scene.x0 <= scene.bounds[1]).all())
        fit = zh.minimize(scene, scene.x0, sigma=0.1, bounds=scene.bounds, loss=torch.mean, max_evaluations=12)
        assert fit.evaluations == 12


def test_bounds_of_names_that_share_a_value_are_those_that_all_accept() -> None:
    """A refractive index accepts everything, a reflectance does not."""

    def metal(mi):
        return {**plane(mi), "disk": {"type": "disk", "bsdf": {"type": "conductor", "eta": rgb(0.2, 0.3, 0.4)}}}

    names = (REFLECTANCE, "disk.bsdf.eta.value")
    for order in (names, names[::-1]):
        lower, upper = scalar(metal, [Value(order)]).bounds
        assert (lower.tolist(), upper.tolist()) == ([0.0] * 3, [1.0] * 3)


PRINCIPLED = ("metallic", "spec_tint", "spec_trans", "clearcoat", "clearcoat_gloss", "sheen", "sheen_tint", "flatness")
CHECKERS = {"type": "checkerboard", "color0": rgb(0.1, 0.1, 0.1), "color1": rgb(0.2, 0.2, 0.2)}


@pytest.mark.parametrize(
    ("thing", "names", "limits"),
    [
        (
            {"bsdf": {"type": "principled"}},
            ("bsdf.specular", *(f"bsdf.{one}.value" for one in ("base_color", "anisotropic", *PRINCIPLED))),
            (0.0, 1.0),
        ),
        ({"bsdf": {"type": "principledthin"}}, ("bsdf.diff_trans.value",), (0.0, 2.0)),
        (
            {"bsdf": {"type": "diffuse", "reflectance": CHECKERS}},
            ("bsdf.reflectance.color0.value", "bsdf.reflectance.color1.value"),
            (0.0, 1.0),
        ),
        (
            {"emitter": {"type": "area", "radiance": CHECKERS}},
            ("emitter.radiance.color0.value", "emitter.radiance.color1.value"),
            (0.0, math.inf),
        ),
        (
            {"bsdf": {"type": "bumpmap", "nested": {"type": "diffuse"}, "texture": CHECKERS}},
            ("bsdf.nested_texture.color0.value",),
            (-math.inf, math.inf),
        ),
    ],
)
def test_bounds_are_what_the_scene_accepts(thing, names, limits) -> None:
    def scene(mi):
        return {**plane(mi), "plane": {"type": "rectangle", **thing}}

    for name in names:
        found = scalar(scene, [Value(f"plane.{name}", elements=1)], depth=2)
        assert tuple(side.item() for side in found.bounds) == limits
        found(torch.tensor([one for one in limits if math.isfinite(one)]).reshape(-1, 1))  # whose pixels are finite


def test_an_environment_map_is_not_negative() -> None:
    def scene(mi):
        sky = {"type": "envmap", "bitmap": mi.Bitmap(np.ones((2, 4, 3), np.float32))}
        return {"type": "scene", "sensor": camera(mi), "mine": sky}

    found = scalar(scene, [Value("mine.data", elements=1)], depth=2)
    assert tuple(side.item() for side in found.bounds) == (0.0, math.inf)


# What is wrong


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ([], r"parameters must be a list of at least one Transform or Value, got \[\]"),
        (3, "parameters must be a list of at least one Transform or Value, got 3"),
        ([Value("plane.bsdf.reflectanse.value")], f"no parameter .*; near ones: {REFLECTANCE}"),
        ([Value(REFLECTANCE), Value(REFLECTANCE)], "more than once"),
        ([Value(REFLECTANCE, bounds=(0, 2))], "bounds of .* must lie within 0 to 1.*got 0 to 2"),
        ([Value(REFLECTANCE, bounds=((0, 1), (0, 1)))], r"a pair \(lower, upper\) or 3 of them"),
        ([Value(REFLECTANCE, bounds=(0, 0.5, 1))], r"a pair \(lower, upper\) or 3 of them, got \(0, 0.5, 1\)"),
        ([Value(REFLECTANCE, bounds=(1, 0))], "lower < upper, got 1, 0"),
        ([Value(REFLECTANCE, unit=0)], "unit must be a number other than 0, got 0"),
        ([Value(REFLECTANCE, elements=2)], "elements must be 1 or None, got 2"),
        ([Value("plane.to_world")], "is a transform: take Transform"),
        ([Transform(REFLECTANCE, move=((1, 0, 0),))], "take Value"),
        ([Transform("plane.to_world")], "at least one vector, got none"),
        ([Transform("plane.to_world", move=((0, 0, 0),))], "not all 0"),
        ([Transform("plane.to_world", move=(1, 0, 0))], "vectors of 3 numbers, not all 0, got 1"),
        ([Transform("plane.to_world", move=((1, 0, 0),), unit=(1.0, 2.0))], "unit must be a number or 1"),
        ([Value((REFLECTANCE, "sensor.x_fov"))], "must have the same size"),
        ([Value("sensor.film.size")], "Value is for real numbers, but sensor.film.size is a (Scalar)?Vector2u"),
        ([Value("allow_thread_reordering")], "Value is for real numbers, but allow_thread_reordering is a bool"),
        (
            [Transform("plane.to_world", move=np.array(1.0))],
            r"plane.to_world: move must be a list of vectors, got 1\.0",
        ),
        ([Transform("plane.to_world", move=np.eye(3)[0])], r"move must be vectors of 3 numbers, not all 0, got 1\.0"),
        ([Transform("plane.to_world", move=[[1, math.nan, 0]])], "plane.to_world: move must be finite, got nan"),
        ([Transform("plane.to_world", move=["abc"])], "move must be vectors of 3 numbers, not all 0, got 'abc'"),
        (
            [Transform("plane.to_world", turn=np.eye(3), pivot=np.ones(2))],
            r"pivot must be a point .*got \[1\.0, 1\.0\]",
        ),
        (
            [Transform("plane.to_world", move=np.eye(3), unit=np.ones(2))],
            r"unit must be a number or 3 .*\[1\.0, 1\.0\]",
        ),
        ([Transform("plane.to_world", move=np.eye(3), unit="a")], "plane.to_world: unit must be a number, got 'a'"),
        (
            [Transform("plane.to_world", move=np.eye(3), bounds=torch.ones(3))],
            r"or 3 of them, got \[1\.0, 1\.0, 1\.0\]",
        ),
        ([Transform("plane.to_world", move=np.eye(3), bounds=(0, None))], "bounds of .* must be a number, got None"),
        ([Transform("plane.to_world", move=np.eye(3), bounds=())], r"bounds of .* must be a pair .*got \(\)"),
        ([Value(REFLECTANCE, unit=np.ones(2))], r"unit must be a number, got \[1\.0, 1\.0\]"),
    ],
)
def test_wrong_parameters(parameters, message) -> None:
    with pytest.raises((ValueError, TypeError), match=message):
        scalar(plane, parameters)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"film": (0, 4)}, r"film must be a pair \(width, height\) of integers >= 1, got \(0, 4\)"),
        ({"film": (8.0, 6.0)}, r"film must be a pair \(width, height\) of integers >= 1, got \(8.0, 6.0\)"),
        ({"film": 8}, r"film must be a pair \(width, height\) of integers >= 1, got 8"),
        ({"spp": 0}, "spp must be from 1 to 2147483647, got 0"),
        ({"depth": 0}, "depth must be from 1 to 2147483647, got 0"),
        ({"seed": -1}, "seed must be from 0 to 2147483647, got -1"),
        ({"seed": 2**32}, "seed must be from 0 to 2147483647, got 4294967296"),
        ({"depth": 2, "integrator": {"type": "path"}}, "give either depth or integrator, got both"),
        ({"noise": "none"}, "noise must be one of fixed, call, point, got 'none'"),
        ({"nan": "zero"}, "nan must be one of raise, keep, got 'zero'"),
    ],
)
def test_wrong_arguments(arguments, message) -> None:
    with pytest.raises(ValueError, match=message):
        scalar(plane, [Value(REFLECTANCE)], **arguments)


def test_wrong_points() -> None:
    scene = scalar(lamp, [Value(RADIANCE)])
    for wrong in (torch.zeros(3), torch.zeros(2, 4)):
        with pytest.raises(ValueError, match=r"x must have shape \[K, 3\]"):
            scene(wrong)
    with pytest.raises(TypeError, match=r"x must be a tensor \[K, 3\], got ndarray"):
        scene(np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"x must have shape \[3\]"):
        scene.set(torch.zeros(2))
    with pytest.raises(TypeError, match=r"loss must return one number per image, got None"):
        scalar(lamp, [Value(RADIANCE)], loss=lambda image: None)(torch.zeros(1, 3))
    with pytest.raises(ValueError, match=r"must be finite, got nan for .*\[1\] in point 0"):
        scene(torch.tensor([[0.0, math.nan, 0.0]]))
    with pytest.raises(ValueError, match=r"must be finite, got inf for .*\[2\]"):
        scene.set(torch.tensor([0.0, 0.0, math.inf]))


def test_missing_files(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no_such_scene\.xml"):
        scalar(tmp_path / "no_such_scene.xml", [Value(RADIANCE)])

    def painted(mi):
        lost = {"type": "bitmap", "filename": str(tmp_path / "lost.png")}
        return {**plane(mi), "plane": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": lost}}}

    with pytest.raises(FileNotFoundError, match=r"lost\.png"):
        scalar(painted, [Value("sky.radiance.value")])


def test_pixels_that_are_not_finite() -> None:
    too_bright = torch.tensor([[1e39, 1.0, 1.0]], dtype=torch.float64)  # infinite in single precision
    with pytest.raises(FloatingPointError, match='not finite, the first at row 0, column 0; nan="keep"'):
        scalar(lamp, [Value(RADIANCE)])(too_bright)
    kept = scalar(lamp, [Value(RADIANCE)], nan="keep")(too_bright)
    assert not bool(torch.isfinite(kept[..., 0]).any())


def test_unknown_variant_says_what_to_use() -> None:
    with pytest.raises(RuntimeError, match="scalar_rgb"):
        scalar(lamp, [Value(RADIANCE)], variant="no_such_variant")


def test_a_scene_says_what_it_is(variant) -> None:
    scene = MitsubaScene(plane, [Value(REFLECTANCE)], film=(5, 3), spp=2, variant=variant, threads=1)
    settings = f"film=(5, 3), spp=2, noise='fixed', variant='{variant}'"
    assert repr(scene) == f"MitsubaScene(n={scene.n}, parameters=[{', '.join(scene.labels)}], {settings})"
    assert scene.n <= 4


def colours(texture, light):
    """A function that describes a ball with a texture under a light."""

    def described(mi):
        made = {**texture, "bitmap": mi.Bitmap(np.full((2, 2, 3), 0.5, np.float32))} if "raw" in texture else texture
        ball = {"type": "sphere", "bsdf": {"type": "diffuse", "reflectance": made}}
        own = {"type": "constant", "radiance": light}
        return {"type": "scene", "integrator": {"type": "path"}, "sensor": camera(mi), "ball": ball, "light": own}

    return described


RAW, BODY = {"type": "bitmap", "raw": True}, {"type": "blackbody", "temperature": 5000.0}
REFUSED = [
    ("spectral", colours(RAW, {"type": "d65"}), r"explicitly disabled! \(raw=true\); leave \"raw\" out"),
    (
        "rgb",
        colours(rgb(0.5, 0.5, 0.5), BODY),
        r"Not implemented for non-spectral modes; a spectrum .* variant of spectra",
    ),
]


@pytest.mark.parametrize("kind", ["scalar", "llvm_ad"])
@pytest.mark.parametrize(("colour", "description", "message"), REFUSED, ids=["raw texture", "spectrum"])
def test_a_render_that_mitsuba_refuses_has_the_cause(kind, colour, description, message):
    """Just-in-time variants say no more than "see above"."""
    if kind == "llvm_ad" and "llvm_ad_rgb" not in VARIANTS:
        pytest.skip("no LLVM that is new enough")
    name = f"{kind}_{colour}"
    scene = MitsubaScene(description, [Transform("ball.to_world", move=((1, 0, 0),))], film=(2, 2), variant=name)
    with pytest.raises(RuntimeError, match=rf"cannot render the scene with variant '{name}': .*{message}") as caught:
        scene(scene.x0[None])
    assert ("it may be in another scene" in str(caught.value)) == (kind == "llvm_ad")
    assert "see above" not in str(caught.value)
    del scene, caught
    gc.collect()
    sound = MitsubaScene(colours(rgb(0.5, 0.5, 0.5), rgb(1.0, 1.0, 1.0)), [Value("ball.bsdf.reflectance.value")])
    assert sound(sound.x0[None]).isfinite().all()
