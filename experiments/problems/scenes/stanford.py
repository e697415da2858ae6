"""The Stanford bunny for tasks, read from the installed package `pymeshfix`, or a bunny of ellipsoids without it.

Lengths are in heights of the bunny; y is up and the origin is the centre of the bounding box. The scan has 50 000
vertices; those in one cell of a grid are merged into one, about 5 000 are left. It is open at the bottom.
"""

import importlib.util
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt

from experiments.problems.scenes.blobs import Ellipsoid, blend
from experiments.problems.scenes.icosphere import Index
from experiments.problems.scenes.meshes import Array, Surface, vertex_normals

Source = Literal["pymeshfix", "procedural"]

CELL = 1 / 40
"""Side of a grid cell, in heights of the bunny."""


def bunny_surface() -> tuple[Surface, Source]:
    """Vertices [m, 3], unit normals [m, 3] and triangles [k, 3], wound counterclockwise, and where they are from."""
    path = _scan()
    if path is None:
        vertices, faces = blend(_ELLIPSOIDS, (-0.10, -0.06, 0.0))
        source: Source = "procedural"
    else:
        points, triangles = read_ply(path)
        turned = np.stack([points[:, 0], points[:, 2], -points[:, 1]], -1)  # z was up
        vertices, faces = cluster(_unit_height(turned), triangles, CELL)
        source = "pymeshfix"
    vertices = _unit_height(vertices)
    return (vertices, vertex_normals(vertices, faces), faces.astype(np.uint32)), source


def _scan() -> Path | None:
    """File of the scan, without importing the package."""
    spec = importlib.util.find_spec("pymeshfix")
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin).parent / "examples" / "StanfordBunny.ply"
    return path if path.is_file() else None


def _unit_height(vertices: Array) -> Array:
    low, high = vertices.min(0), vertices.max(0)
    centred: Array = (vertices - 0.5 * (low + high)) / (high[1] - low[1])
    return centred


def read_ply(path: Path) -> tuple[Array, Index]:
    """Return vertices [m, 3] and triangles [k, 3] of a PLY file, in the order of the file.

    Read by trimesh, because Mitsuba's reader refuses the header of the scan (`obj_info`).
    """
    import trimesh

    mesh = trimesh.load_mesh(path, process=False)
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def cluster(vertices: Array, faces: npt.NDArray[np.integer], cell: float) -> tuple[Array, Index]:
    """Merge the vertices of every grid cell of side `cell` into their mean; collapsed and double triangles go.

    Triangles that this turns over are wound the other way, to face along the normals of the vertices that were merged.

    Returns: vertices [m, 3] and triangles [k, 3].
    """
    keys = np.floor(vertices / cell).astype(np.int64)
    _, member = np.unique(keys, axis=0, return_inverse=True)
    member = member.reshape(-1)
    counts = np.bincount(member)[:, None]
    normals = vertex_normals(vertices, faces)
    means, outward = (np.stack([np.bincount(member, one) for one in of.T], -1) / counts for of in (vertices, normals))
    merged = member[faces]
    merged = merged[(merged != np.roll(merged, 1, axis=1)).all(1)]
    _, first = np.unique(np.sort(merged, axis=1), axis=0, return_index=True)
    merged = merged[first]
    a, b, c = (means[merged[:, k]] for k in range(3))
    inward = (np.cross(b - a, c - a) * outward[merged].sum(1)).sum(1) < 0
    merged[inward] = merged[inward, ::-1]
    used, renamed = np.unique(merged, return_inverse=True)
    return means[used], renamed.reshape(-1, 3)


_ELLIPSOIDS: tuple[Ellipsoid, ...] = (
    ((0.00, -0.22, 0.00), (0.30, 0.26, 0.25)),  # body
    ((0.20, -0.28, 0.02), (0.20, 0.20, 0.24)),  # haunches
    ((-0.24, 0.06, 0.02), (0.20, 0.17, 0.16)),  # head
    ((-0.17, 0.33, 0.10), (0.06, 0.22, 0.05)),  # ears
    ((-0.11, 0.30, -0.09), (0.06, 0.20, 0.05)),
    ((0.42, -0.30, 0.02), (0.08, 0.08, 0.08)),  # tail
    ((-0.22, -0.40, 0.10), (0.12, 0.07, 0.07)),  # paws
    ((-0.22, -0.40, -0.10), (0.12, 0.07, 0.07)),
)
