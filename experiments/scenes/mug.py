"""A coffee mug on a curved backdrop whose handle turns about the vertical axis (tasks MUG and CNN).

One parameter, in degrees: the handle is seen in profile at 0, points at the camera near 257 and is hidden behind the
body from 40 to 100, where the image does not change: a plateau of every image loss. The body is a solid of revolution,
so only the handle moves. Lengths are metres and y is up; the meshes are computed here.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from torch_zerohess.adapters.mitsuba import select_variant

Array = npt.NDArray[np.float64]
Image = npt.NDArray[np.float32]
Surface = tuple[Array, Array, npt.NDArray[np.uint32]]  # vertices [m, 3], unit normals [m, 3], triangles [k, 3]

RADIUS, HEIGHT, WALL = 0.040, 0.098, 0.0036
HANDLE_REACH, HANDLE_LEVEL, HANDLE_SPAN, HANDLE_POWER = 0.032, 0.051, 0.030, 2.7
HANDLE_TUBE = (0.0062, 0.0040)  # half widths across and along the plane of the handle
CAMERA, FIELD_OF_VIEW = (0.27507, 0.084647, 0.060803), 39.6  # the field of view is that of the film's width
LIGHTS = (((0.0, 0.75, -0.35), 0.15, 7.0), ((0.55, 0.6, 0.35), 0.2, 12.0))  # centre, radius, radiance
MUG_COLOR, BACKDROP_COLOR = (0.80, 0.20, 0.09), (0.83, 0.79, 0.73)


class MugScene:
    """Renders of the mug, one per angle of its handle; the scene is loaded once and reused.

    Example: ``MugScene(film=64).render([200.0, 257.0])`` has shape [2, 64, 64, 3].

    Args:
        film: width and height in pixels, or one number for a square; (256, 192) in the paper.
        spp: samples per pixel; 32 in the paper.
        depth: longest path, at least 2 (direct light only, the default); 6 in the paper.
        seed: of the renders, the same for every angle: fresh noise would be as large as the loss.
        variant: Mitsuba variant, see :func:`torch_zerohess.adapters.mitsuba.select_variant`.
        threads: render threads; None for all cores.

    Raises:
        TypeError, ValueError: an argument of the wrong type or out of range.
        ModuleNotFoundError: Mitsuba is not installed.
        RuntimeError: the variant does not work on this machine.

    """

    # Depth 2, not 6: at 64x64 the MSE over all angles has the same minimum and plateau (correlation 0.997, at most 7 %
    # of its peak apart, where 8 spp alone moves it by 16 %), half the noise variance and a third of the time.
    def __init__(
        self,
        film: int | tuple[int, int] = 64,
        spp: int = 8,
        depth: int = 2,
        seed: int = 0,
        variant: str = "auto",
        threads: int | None = None,
    ) -> None:
        sizes = (film, film) if isinstance(film, int) else tuple(film)
        if len(sizes) != 2 or min(sizes) < 1:
            raise ValueError(f"film must be a size in pixels >= 1 or a pair (width, height) of them, got {film!r}")
        for name, value, least in (("spp", spp, 1), ("depth", depth, 2), ("seed", seed, 0)):
            if not isinstance(value, int):
                raise TypeError(f"{name} must be an int, got {value!r}")
            if value < least:
                raise ValueError(f"{name} must be at least {least}, got {value}")
        self.film, self.spp, self.depth, self.seed = (int(sizes[0]), int(sizes[1])), spp, depth, seed
        self._mi: Any = select_variant(variant, threads)
        self.variant: str = self._mi.variant()
        self._scene = self._mi.load_dict(self._description(), optimize=False)  # optimize=True drops parameter names
        self._params = self._mi.traverse(self._scene)
        self._params.keep(["handle.to_world"])

    def render(self, angles: Sequence[float]) -> Image:
        """Linear RGB images [K, height, width, 3] of the handle turned by ``angles`` [K] in degrees, any finite value.

        The same angle gives the same bits, whatever was rendered before.

        Raises:
            ValueError: ``angles`` is not a sequence of finite numbers.

        """
        degrees = np.asarray(angles, np.float64)
        if degrees.ndim != 1:
            raise ValueError(f"angles must be one-dimensional [K], got shape {list(degrees.shape)}")
        if not np.isfinite(degrees).all():
            first = int(np.flatnonzero(~np.isfinite(degrees))[0])
            raise ValueError(f"angles must be finite (degrees), got angles[{first}] = {degrees[first]}")
        width, height = self.film
        images = np.empty((degrees.size, height, width, 3), np.float32)
        for image, angle in zip(images, degrees % 360.0, strict=True):
            self._params["handle.to_world"] = self._turn((0.0, 1.0, 0.0), float(angle))
            self._params.update()
            image[...] = np.asarray(self._mi.render(self._scene, spp=self.spp, seed=self.seed))
        return images

    def _turn(self, axis: tuple[float, float, float], degrees: float) -> Any:
        return self._mi.ScalarTransform4f().rotate(list(axis), degrees)  # takes no NumPy scalars

    def _description(self) -> dict[str, Any]:
        width, height = self.film
        view = self._mi.ScalarTransform4f().translate(list(CAMERA)) @ self._turn((0.0, 0.0, 1.0), -180.0)
        view = view @ self._turn((0.0, 1.0, 0.0), -80.0) @ self._turn((1.0, 0.0, 0.0), -172.0)
        # Direct light needs one shadow ray and no ray towards the lights, which are large and out of view.
        integrator = (
            {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0}
            if self.depth == 2
            else {"type": "path", "max_depth": self.depth, "rr_depth": self.depth}
        )
        matte = {"type": "diffuse", "reflectance": _rgb(BACKDROP_COLOR)}
        glaze = {"type": "roughplastic", "alpha": 0.15, "nonlinear": True, "diffuse_reflectance": _rgb(MUG_COLOR)}
        film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb", "rfilter": {"type": "box"}}
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": integrator | {"block_size": 8},
            "sensor": {
                "type": "perspective",
                "fov": FIELD_OF_VIEW,
                "fov_axis": "x",
                "to_world": view,
                "near_clip": 0.01,
                "film": film,
            },
            # The still shapes are one instance too: a turn then costs half of what it does with them at the top.
            "still": {
                "type": "shapegroup",
                "backdrop": self._mesh("backdrop", backdrop(), matte),
                "body": self._mesh("body", body(), glaze),
            },
            "turned": {"type": "shapegroup", "mesh": self._mesh("handle", handle(), glaze)},
            "rest": {"type": "instance", "group": {"type": "ref", "id": "still"}},
            "handle": {"type": "instance", "group": {"type": "ref", "id": "turned"}},
        }
        for i, (center, radius, radiance) in enumerate(LIGHTS):
            light = {"type": "area", "radiance": {"type": "rgb", "value": radiance}}
            scene[f"light{i}"] = {"type": "sphere", "center": list(center), "radius": radius, "emitter": light}
        return scene

    def _mesh(self, name: str, surface: Surface, bsdf: dict[str, Any]) -> Any:
        """A ``mi.Mesh``, filled in the one way that scalar and just-in-time variants share."""
        vertices, normals, faces = surface
        properties = self._mi.Properties()
        properties["bsdf"] = self._mi.load_dict(bsdf)
        mesh = self._mi.Mesh(name, len(vertices), len(faces), properties, has_vertex_normals=True)
        params = self._mi.traverse(mesh)
        for key, values in (
            ("vertex_positions", vertices.astype(np.float32)),
            ("vertex_normals", normals.astype(np.float32)),
            ("faces", faces),
        ):
            params[key] = type(params[key])(values.ravel())
        params.update()
        return mesh


def _rgb(color: tuple[float, float, float]) -> dict[str, Any]:
    return {"type": "rgb", "value": list(color)}


def body(sides: int = 64) -> Surface:
    """The mug without its handle: a profile with rounded foot, lip and inner floor, turned about the y axis."""
    inner = RADIUS - WALL
    corners = ((0.0, 0.0), (RADIUS, 0.0), (RADIUS, HEIGHT), (inner, HEIGHT), (inner, 0.006), (0.0, 0.006))
    profile, normals = _rounded(corners, (0.0, 0.006, 0.49 * WALL, 0.49 * WALL, 0.012, 0.0))
    turn = np.linspace(0.0, 2.0 * math.pi, sides + 1)[:, None]
    ring = np.cos(turn), np.ones_like(turn), np.sin(turn)
    vertices, directions = (
        np.stack([axis * curve[:, k] for axis, k in zip(ring, (0, 1, 0), strict=True)], -1)
        for curve in (profile, normals)
    )
    return _grid(vertices, directions)


def handle(rings: int = 32, sides: int = 12) -> Surface:
    """A flattened tube swept along half a superellipse (a D) that points to -z; its open ends are inside the wall."""
    t = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 2001)
    bend = 2.0 / HANDLE_POWER
    reach = RADIUS - 0.6 * WALL + HANDLE_REACH * np.abs(np.cos(t)) ** bend
    level = HANDLE_LEVEL + HANDLE_SPAN * np.sign(t) * np.abs(np.sin(t)) ** bend
    length = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(reach), np.diff(level)))])
    equal = np.linspace(0.0, length[-1], rings + 1)
    reach, level = np.interp(equal, length, reach), np.interp(equal, length, level)
    run, rise = np.gradient(reach), np.gradient(level)
    run, rise = run / np.hypot(run, rise), rise / np.hypot(run, rise)
    flare = 1.0 + 0.35 * np.exp(-np.minimum(equal, equal[::-1]) / 0.006)
    turn = np.linspace(0.0, 2.0 * math.pi, sides + 1)[:, None]
    cos, sin = np.cos(turn), np.sin(turn) + 0.0 * reach
    across, along = HANDLE_TUBE
    vertices = np.stack(
        [across * flare * sin, level - along * flare * cos * run, -reach - along * flare * cos * rise], -1
    )
    normals = np.stack([sin / across, -cos * run / along, -cos * rise / along], -1)
    return _grid(vertices, normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def backdrop() -> Surface:
    """Floor and wall joined by a quarter circle, behind the mug as the camera sees it."""
    profile, normals = _rounded(((1.0, 0.0), (-0.7, 0.0), (-0.7, 1.2)), (0.0, 0.45, 0.0), steps=24)
    across = np.array([[1.2], [-1.2]])
    vertices = np.stack(np.broadcast_arrays(profile[:, 0], profile[:, 1], across), -1)
    directions = np.stack(np.broadcast_arrays(normals[:, 0], normals[:, 1], 0.0 * across), -1)
    return _grid(vertices, directions)


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


def _grid(vertices: Array, normals: Array) -> Surface:
    """Triangles of a grid [a, b, 3] of vertices, wound so that they face along the normals; degenerate ones left out.

    Returns: vertices [a * b, 3], normals [a * b, 3], faces [m, 3].
    """
    index = np.arange(vertices.shape[0] * vertices.shape[1]).reshape(vertices.shape[:2])
    a, b, c, d = index[:-1, :-1].ravel(), index[1:, :-1].ravel(), index[1:, 1:].ravel(), index[:-1, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)])
    vertices, normals = vertices.reshape(-1, 3), normals.reshape(-1, 3)
    corner = vertices[faces]
    area = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    faces = np.where((area * normals[faces].sum(1)).sum(-1, keepdims=True) < 0.0, faces[:, ::-1], faces)
    return vertices, normals, faces[np.linalg.norm(area, axis=-1) > 1e-12].astype(np.uint32)


def to_srgb(image: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """8-bit sRGB of a linear RGB image, for pictures; values outside [0, 1] are clipped."""
    linear = np.clip(np.asarray(image, np.float64), 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * curved).astype(np.uint8)
