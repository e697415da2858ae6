"""Meshes that others are fitted to: the Stanford bunny, Suzanne and a banana; the last two are in the source.

Lengths are such that the longest side of the bounding box is 1, for the bunny its height; y is up, the origin is the
centre of the box.

Suzanne is the head of a monkey that comes with Blender: `bmesh.ops.create_monkey` of the package `bpy`, where that is
installed, otherwise a head of ellipsoids. The banana is a formula: a tube with five soft edges along an arc, thin at
both ends, with colours at its vertices.
"""

import importlib.util
import json
import math
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt

from experiments.problems.scenes.blobs import Ellipsoid, blend
from experiments.problems.scenes.icosphere import Index
from experiments.problems.scenes.meshes import grid
from experiments.problems.scenes.stanford import bunny_surface

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Target:
    """A mesh: vertices [m, 3], triangles [k, 3] wound counterclockwise, colours [m, 3] or None, and its source."""

    name: str
    vertices: Array
    faces: Index
    colors: Array | None
    source: str


def bunny() -> Target:
    """The Stanford bunny, of one colour."""
    (vertices, _, faces), source = bunny_surface()
    return Target("the Stanford bunny", vertices, faces.astype(np.int64), None, source)


def painted_bunny() -> Target:
    """The Stanford bunny with colours in 0.15 to 0.95 that vary smoothly with the place."""
    plain = bunny()
    waves = np.array([[2.0, 4.0, 0.0], [0.0, 3.0, 5.0], [5.0, 0.0, 3.0]])
    colors = 0.55 + 0.4 * np.sin(plain.vertices @ waves.T + np.array([0.5, 2.0, 4.0]))
    return Target("a painted Stanford bunny", plain.vertices, plain.faces, colors, plain.source)


def suzanne() -> Target:
    """The head of Blender's monkey, of one colour; it looks along z."""
    found = _blender()
    vertices, faces = found or blend(_HEAD, (0.0, 0.0, -0.05))
    name = "Suzanne" if found else "a head of ellipsoids, for Suzanne"
    return Target(name, _fitted(vertices), faces, None, "bpy" if found else "procedural")


_HEAD: tuple[Ellipsoid, ...] = (
    ((0.00, 0.06, -0.05), (0.30, 0.28, 0.27)),  # skull
    ((0.00, -0.20, 0.14), (0.17, 0.14, 0.16)),  # muzzle
    ((0.10, 0.12, 0.20), (0.10, 0.08, 0.06)),  # brows
    ((-0.10, 0.12, 0.20), (0.10, 0.08, 0.06)),
    ((0.38, 0.06, -0.05), (0.13, 0.15, 0.05)),  # ears
    ((-0.38, 0.06, -0.05), (0.13, 0.15, 0.05)),
    ((0.00, -0.04, 0.24), (0.04, 0.06, 0.04)),  # nose
)

# A child process: the package loads libraries of its own, prints, and must not come between torch and NumPy.
_CHILD = """
import bmesh, json
mesh = bmesh.new()
bmesh.ops.create_monkey(mesh)
bmesh.ops.triangulate(mesh, faces=mesh.faces[:])
mesh.verts.index_update()
print(json.dumps([[tuple(v.co) for v in mesh.verts], [[v.index for v in f.verts] for f in mesh.faces]]))
"""


@cache
def _blender() -> tuple[Array, Index] | None:
    """Vertices [507, 3] and triangles [968, 3] of Suzanne; None where the package is missing or does not run."""
    if importlib.util.find_spec("bpy") is None:
        return None
    done = subprocess.run(
        [sys.executable, "-c", f"import bpy\n{_CHILD}"], capture_output=True, text=True, timeout=120, check=False
    )
    if done.returncode != 0:
        return None
    vertices, faces = json.loads(done.stdout.splitlines()[-1])
    x, y, z = np.array(vertices, np.float64).T
    return np.stack([x, z, -y], 1), np.array(faces, np.int64)


ALONG, AROUND = 96, 40
"""Rings of the banana and vertices of each."""
_BEND, _RADIUS = 1.9, 0.115
"""Angle of the arc, and the largest radius of the tube, for an arc of radius 0.5."""


def banana() -> Target:
    """A banana with colours: yellow, brown at both ends, green at the neck."""
    t = np.linspace(0.0, 1.0, ALONG)[:, None]
    around = np.linspace(0.0, 2 * math.pi, AROUND + 1)[None, :-1]
    angle = _BEND * (t - 0.5)
    body = np.clip(np.minimum(t / 0.24, (1.0 - t) / 0.10), 0.0, 1.0)
    stem = np.where(t < 0.12, 0.3, 0.0)
    radius = _RADIUS * np.maximum(np.sqrt(body * (2.0 - body)), stem)
    radius = np.where((t == 0.0) | (t == 1.0), 0.0, radius) * (1.0 + 0.04 * np.cos(5 * around))
    outward = np.stack([np.sin(angle), -np.cos(angle), np.zeros_like(angle)], -1)  # from the centre of the arc
    sideways = np.array([0.0, 0.0, 1.0])
    direction = np.cos(around)[..., None] * outward + np.sin(around)[..., None] * sideways
    rings = 0.5 * outward + radius[..., None] * direction
    closed = np.concatenate([rings, rings[:, :1]], 1)
    vertices, _, faces = grid(closed, np.concatenate([direction, direction[:, :1]], 1))
    yellow, brown, green = np.array([0.93, 0.80, 0.16]), np.array([0.25, 0.16, 0.08]), np.array([0.55, 0.70, 0.18])
    neck, ends = np.exp(-(((t - 0.16) / 0.07) ** 2)), np.maximum(np.exp(-t / 0.03), np.exp(-(1.0 - t) / 0.02))
    ring = (1 - ends) * ((1 - neck) * yellow + neck * green) + ends * brown
    colors = np.repeat(ring, AROUND + 1, axis=0)
    merged, triangles = _without_seam(faces.astype(np.int64))
    return Target("a banana", _fitted(vertices[merged]), triangles, colors[merged], "procedural")


def _without_seam(faces: Index) -> tuple[Index, Index]:
    """Join the first and the last column of the grid, and each of the two ends to one vertex.

    Returns: the kept vertices, by their numbers in the grid, and triangles [k, 3] over them.
    """
    number = np.arange(ALONG * (AROUND + 1)).reshape(ALONG, AROUND + 1)
    joined = number.copy()
    joined[:, -1] = joined[:, 0]
    joined[0], joined[-1] = joined[0, 0], joined[-1, 0]
    triangles = joined.ravel()[faces]
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(1)]
    kept, renamed = np.unique(triangles, return_inverse=True)
    return kept, renamed.reshape(-1, 3)


def _fitted(vertices: Array) -> Array:
    """Move the centre of the bounding box to the origin and make its longest side 1."""
    low, high = vertices.min(0), vertices.max(0)
    centred: Array = (vertices - 0.5 * (low + high)) / (high - low).max()
    return centred


TARGETS: dict[str, Callable[[], Target]] = {
    "meshfit": bunny,
    "meshfit_color": painted_bunny,
    "suzanne": suzanne,
    "banana": banana,
}
"""Targets by the names of their tasks."""
