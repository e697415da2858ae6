"""A coffee mug on a curved backdrop, whose handle turns about the vertical axis (tasks MUG and the CNN ones).

At 0 degrees the handle is seen in profile; it points at the camera near 257 and is hidden behind the body from 40 to
100, where the image does not change: a plateau of every image loss. The body is a solid of revolution, so where only
the rotation is sought only the handle moves. Lengths are metres and y is up; the meshes are computed here.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from experiments.problems.scenes.meshes import Array, Surface, grid
from experiments.problems.scenes.parts import camera, instance, mi_mesh, rgb
from torch_zerohess.adapters.mitsuba import MitsubaScene, Parameter, Transform, Value

DEGREES = 20.0
"""Degrees per unit of a rotation."""
ROTATION = Transform("handle.to_world", turn=((0.0, 1.0, 0.0),), unit=DEGREES)
"""One column: the handle, in units of 20 degrees."""
MESH_ROTATION = replace(ROTATION, name="handle.vertex_positions", pivot=(0.0, 0.0, 0.0))
"""The same without instances."""
POSE = Transform(
    ("body.to_world", "handle.to_world"), move=((0.0, 0.0, 1.0),), turn=((0.0, 1.0, 0.0),), unit=(0.01, DEGREES)
)
"""Two columns: position across the view in centimetres, and rotation in units of 20 degrees."""
COLOR = Value(("mug.mesh.bsdf.diffuse_reflectance.value", "turned.mesh.bsdf.diffuse_reflectance.value"))
"""Three columns: diffuse reflectance of the mug, 0 to 1."""
LABEL = Value("sticker.mesh.bsdf.reflectance.data")
"""1024 columns: reflectance of the 32x32 pixels of the label, row by row from below, 0 to 1; needs `label=True`."""

RADIUS, HEIGHT, WALL = 0.040, 0.098, 0.0036
HANDLE_REACH, HANDLE_LEVEL, HANDLE_SPAN, HANDLE_POWER = 0.032, 0.051, 0.030, 2.7
HANDLE_TUBE = (0.0062, 0.0040)  # half widths across and along the plane of the handle
BODY_SIDES, LABEL_COLUMNS, HANDLE_RINGS, HANDLE_SIDES = 64, 32, 32, 12  # of the meshes
LABEL_SIDE, LABEL_HEIGHTS, LABEL_ARC = 32, (0.016, 0.086), 1.9  # pixels, metres, radians about the camera's azimuth
CAMERA, FIELD_OF_VIEW = (0.27507, 0.084647, 0.060803), 39.6  # the field of view is along the width of the film
LIGHTS = (((0.0, 0.75, -0.35), 0.15, 7.0), ((0.55, 0.6, 0.35), 0.2, 12.0))  # centre, radius, radiance
MUG_COLOR, BACKDROP_COLOR = (0.80, 0.20, 0.09), (0.83, 0.79, 0.73)
DIRECT = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0, "block_size": 8}
"""Direct light takes one shadow ray and no ray towards the lights, which are large and out of view."""


# Depth 2, not 6: at 64x64 the MSE over all angles has the same minimum and plateau (correlation 0.997, at most 7 %
# of its peak apart, where 8 spp alone moves it by 16 %), half the noise variance and a third of the time.
def mug_scene(
    parameters: Sequence[Parameter] = (ROTATION,),
    film: tuple[int, int] = (64, 64),
    spp: int = 8,
    depth: int = 2,
    label: bool = False,
    instances: bool = True,
    **more: Any,
) -> MitsubaScene:
    """Return the scene as a black box.

    Args:
        parameters: some of `ROTATION` or `POSE`, `COLOR`, `LABEL`.
        film: width and height in pixels; (256, 192) in the paper.
        spp: samples per pixel; 32 in the paper.
        depth: longest path, at least 2 (direct light only); 6 in the paper.
        label: whether a grey label is on the front of the mug.
        instances: of `mug`.
        more: of `MitsubaScene`.
    """
    if depth < 2:
        raise ValueError(f"depth must be at least 2, direct light, got {depth}")
    way = {"integrator": DIRECT} if depth == 2 else {"depth": depth}
    return MitsubaScene(lambda mi: mug(mi, label, instances), parameters, film=film, spp=spp, **way, **more)


def mug(mi: Any, label: bool = False, instances: bool = True) -> dict[str, Any]:
    """Return the scene for `mitsuba.load_dict`, the handle at 0 degrees; without instances `handle` is a mesh."""
    turn = mi.ScalarTransform4f().translate(list(CAMERA)).rotate([0, 0, 1], -180.0)
    view = turn.rotate([0, 1, 0], -80.0).rotate([1, 0, 0], -172.0)
    matte = {"type": "diffuse", "reflectance": rgb(*BACKDROP_COLOR)}
    glaze = {"type": "roughplastic", "alpha": 0.15, "nonlinear": True, "diffuse_reflectance": rgb(*MUG_COLOR)}
    scene: dict[str, Any] = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6, "rr_depth": 6},
        "sensor": {**camera(view, FIELD_OF_VIEW, (256, 192)), "near_clip": 0.01},
    }
    meshes = [
        ("still", "room", mi_mesh(mi, "backdrop", backdrop(), matte)),
        ("mug", "body", mi_mesh(mi, "body", body(), glaze)),
        ("turned", "handle", mi_mesh(mi, "handle", handle(), glaze)),
    ]
    if label:
        grey = mi.Bitmap(np.full((LABEL_SIDE, LABEL_SIDE, 1), 0.5, np.float32))
        picture = {"type": "bitmap", "bitmap": grey, "raw": True, "filter_type": "nearest", "wrap_mode": "clamp"}
        paper = {"type": "diffuse", "reflectance": picture}
        surface, uv = sticker()
        meshes.append(("sticker", "label", mi_mesh(mi, "label", surface, paper, uv)))
    for group, name, mesh in meshes:
        # Instances, also of what never moves: a turn then costs half of what it does with a mesh at the top.
        scene |= instance(name, group, mesh) if instances else {name: mesh}
    for i, (center, radius, radiance) in enumerate(LIGHTS):
        light = {"type": "area", "radiance": rgb(radiance)}
        scene[f"light{i}"] = {"type": "sphere", "center": list(center), "radius": radius, "emitter": light}
    return scene


def body() -> Surface:
    """The mug without its handle: a profile with rounded foot, lip and inner floor, turned about the y axis."""
    inner = RADIUS - WALL
    corners = ((0.0, 0.0), (RADIUS, 0.0), (RADIUS, HEIGHT), (inner, HEIGHT), (inner, 0.006), (0.0, 0.006))
    profile, normals = _rounded(corners, (0.0, 0.006, 0.49 * WALL, 0.49 * WALL, 0.012, 0.0))
    turn = np.linspace(0.0, 2.0 * math.pi, BODY_SIDES + 1)[:, None]
    ring = np.cos(turn), np.ones_like(turn), np.sin(turn)
    vertices, directions = (
        np.stack([axis * curve[:, k] for axis, k in zip(ring, (0, 1, 0), strict=True)], -1)
        for curve in (profile, normals)
    )
    return grid(vertices, directions)


def sticker() -> tuple[Surface, Array]:
    """The label, a part of a cylinder just off the body that faces the camera, and its texture coordinates."""
    middle = math.atan2(CAMERA[2], CAMERA[0])
    u, v = np.meshgrid(np.linspace(0.0, 1.0, LABEL_COLUMNS + 1), np.array([0.0, 1.0]))
    turn = middle - LABEL_ARC * (u - 0.5)
    low, high = LABEL_HEIGHTS
    normals = np.stack([np.cos(turn), np.zeros_like(turn), np.sin(turn)], -1)
    vertices = (RADIUS + 0.0004) * normals
    vertices[..., 1] = low + (high - low) * v
    return grid(vertices, normals), np.stack([u, v], -1).reshape(-1, 2)


def handle() -> Surface:
    """A flattened tube swept along half a superellipse (a D) that points to -z; its open ends are inside the wall."""
    t = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 2001)
    bend = 2.0 / HANDLE_POWER
    reach = RADIUS - 0.6 * WALL + HANDLE_REACH * np.abs(np.cos(t)) ** bend
    level = HANDLE_LEVEL + HANDLE_SPAN * np.sign(t) * np.abs(np.sin(t)) ** bend
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(reach), np.diff(level)))])
    equal = np.linspace(0.0, length[-1], HANDLE_RINGS + 1)
    reach, level = np.interp(equal, length, reach), np.interp(equal, length, level)
    run, rise = np.gradient(reach), np.gradient(level)
    run, rise = run / np.hypot(run, rise), rise / np.hypot(run, rise)
    flare = 1.0 + 0.35 * np.exp(-np.minimum(equal, equal[::-1]) / 0.006)
    turn = np.linspace(0.0, 2.0 * math.pi, HANDLE_SIDES + 1)[:, None]
    cos, sin = np.cos(turn), np.sin(turn) + 0.0 * reach
    across, along = HANDLE_TUBE
    vertices = np.stack(
        [across * flare * sin, level - along * flare * cos * run, -reach - along * flare * cos * rise], -1
    )
    normals = np.stack([sin / across, -cos * run / along, -cos * rise / along], -1)
    return grid(vertices, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def backdrop() -> Surface:
    """Floor and wall joined by a quarter circle, behind the mug as the camera sees it."""
    profile, normals = _rounded(((1.0, 0.0), (-0.7, 0.0), (-0.7, 1.2)), (0.0, 0.45, 0.0), steps=24)
    across = np.array([[1.2], [-1.2]])
    vertices = np.stack(np.broadcast_arrays(profile[:, 0], profile[:, 1], across), -1)
    directions = np.stack(np.broadcast_arrays(normals[:, 0], normals[:, 1], 0.0 * across), -1)
    return grid(vertices, directions)


def _rounded(corners: Sequence[tuple[float, float]], radii: Sequence[float], steps: int = 4) -> tuple[Array, Array]:
    """Polyline [m, 2] through ``corners`` with each corner an arc of its radius, and unit normals to its right."""
    points = np.asarray(corners)
    heading = np.diff(points, axis=0)
    heading /= np.linalg.norm(heading, axis=1, keepdims=True)
    right = np.stack([heading[:, 1], -heading[:, 0]], -1)
    curve, normals = [points[:1]], [right[:1]]
    for corner, radius, d, e, n in zip(points[1:-1], radii[1:-1], heading, heading[1:], right, strict=False):
        bend = math.atan2(d[0] * e[1] - d[1] * e[0], d @ e)
        side = math.copysign(radius, bend)
        center = corner - d * radius * math.tan(abs(bend) / 2.0) - side * n
        a = np.linspace(0.0, bend, steps + 1)[:, None]
        arc = np.cos(a) * n + np.sin(a) * np.array([-n[1], n[0]])
        curve.append(center + side * arc)
        normals.append(arc)
    return np.concatenate([*curve, points[-1:]]), np.concatenate([*normals, right[-1:]])
