"""The icosphere: an icosahedron whose triangles are split into four, with the new vertices pushed out to the sphere.

The vertices of a level come first in the next level, so a prefix of an array over vertices is the array over a coarser
sphere. Level L has 10 * 4^L + 2 vertices and 20 * 4^L triangles: 12, 42, 162, 642, 2562, ...

trimesh has an icosphere too, and a test compares the two. This one is kept because the parameters of MESHFIT are the
vertices in this order, and because `split` returns the edges that the rows of a subdivision matrix stand for.
"""

import math

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]


def icosphere(level: int) -> tuple[Array, Index]:
    """Unit vertices [10 * 4^level + 2, 3] and triangles [20 * 4^level, 3], counterclockwise as seen from outside.

    Raises:
        ValueError: the level is negative.

    Example:
        >>> vertices, faces = icosphere(4)
        >>> vertices.shape, faces.shape
        ((2562, 3), (5120, 3))
    """
    if level < 0:
        raise ValueError(f"level must be at least 0, got {level}")
    vertices, faces = _icosahedron()
    for _ in range(level):
        faces, ends = split(faces, len(vertices))
        middles = vertices[ends].sum(1)
        vertices = np.concatenate([vertices, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
    return vertices, faces


def split(faces: Index, count: int) -> tuple[Index, Index]:
    """Split every triangle [k, 3] over `count` vertices into four by the middles of its edges.

    Returns: triangles [4 k, 3], and the two ends [e, 2] of every edge, whose middle is vertex number count + edge.
    """
    sides = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], -1), -1)  # [k, 3, 2]
    ends, edge = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    middle = count + edge.reshape(-1, 3)
    (a, b, c), (ab, bc, ca) = faces.T, middle.T
    corners = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(three, -1) for three in corners]), ends


def _icosahedron() -> tuple[Array, Index]:
    """Three golden rectangles; its triangles are the triples of vertices that are neighbours of each other."""
    golden = (1 + math.sqrt(5)) / 2
    rectangle = np.array([[0, s, t * golden] for s in (-1, 1) for t in (-1, 1)])
    vertices = np.concatenate([np.roll(rectangle, k, axis=1) for k in range(3)]) / math.hypot(1, golden)
    near = vertices @ vertices.T > 0.4  # neighbours have the cosine 1/sqrt(5)
    triples = [
        (i, j, k)
        for i in range(12)
        for j in range(i + 1, 12)
        for k in range(j + 1, 12)
        if near[i, j] and near[j, k] and near[i, k]
    ]
    faces = np.array(triples)
    outward = np.linalg.det(vertices[faces]) > 0
    return vertices, np.where(outward[:, None], faces, faces[:, ::-1])
