"""Meshes as arrays, and what becomes of them in Mitsuba."""

from typing import Any

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Surface = tuple[Array, Array, npt.NDArray[np.uint32]]
"""Vertices [m, 3], unit normals [m, 3], triangles [k, 3]."""


def mi_mesh(mi: Any, name: str, surface: Surface, bsdf: dict[str, Any], uv: Array | None = None) -> Any:
    """Return a ``mi.Mesh`` with texture coordinates uv [m, 2], filled in the one way that all variants share."""
    vertices, normals, faces = surface
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(bsdf)
    mesh = mi.Mesh(
        name, len(vertices), len(faces), properties, has_vertex_normals=True, has_vertex_texcoords=uv is not None
    )
    params = mi.traverse(mesh)
    arrays: dict[str, npt.NDArray[Any]] = {"vertex_positions": vertices, "vertex_normals": normals, "faces": faces}
    if uv is not None:
        arrays["vertex_texcoords"] = uv
    for key, values in arrays.items():
        params[key] = type(params[key])(values.astype(np.uint32 if key == "faces" else np.float32).ravel())
    params.update()
    return mesh


def instance(name: str, group: str, shape: Any, pose: Any = None) -> dict[str, Any]:
    """Parts of a scene: the group `group` of one shape and its instance `name`, which moves fast.

    Mitsuba differentiates through an instance, but does not sample its silhouette.
    """
    of: dict[str, Any] = {"type": "instance", "group": {"type": "ref", "id": group}}
    return {group: {"type": "shapegroup", "mesh": shape}, name: of if pose is None else {**of, "to_world": pose}}


def rgb(*color: float) -> dict[str, Any]:
    """Colour or grey as a dictionary of Mitsuba."""
    return {"type": "rgb", "value": list(color) if len(color) > 1 else color[0]}


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


def to_srgb(image: npt.ArrayLike) -> npt.NDArray[np.uint8]:
    """8-bit sRGB of a linear RGB image, for pictures; values outside [0, 1] are clipped."""
    linear = np.clip(np.asarray(image, np.float64), 0.0, 1.0)
    curved = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1.0 / 2.4) - 0.055)
    return np.rint(255.0 * curved).astype(np.uint8)
