"""Triangle meshes as arrays."""

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Surface = tuple[Array, Array, npt.NDArray[np.uint32]]
"""Vertices [m, 3], unit normals [m, 3], triangles [k, 3]."""


def grid(vertices: Array, normals: Array) -> Surface:
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


def vertex_normals(vertices: Array, faces: npt.NDArray[np.integer]) -> Array:
    """Unit normals [m, 3]: the mean of the adjacent triangles' normals, weighted by area."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    normals = np.zeros_like(vertices)
    for k in range(3):
        np.add.at(normals, faces[:, k], area)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
