"""Parts of the scenes that `mitsuba.load_dict` gets: meshes, instances, cameras and colours."""

from typing import Any

import numpy as np
import numpy.typing as npt

from experiments.problems.scenes.meshes import Array, Surface


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


def camera(view: Any, field_of_view: float, film: tuple[int, int]) -> dict[str, Any]:
    """Return a pinhole camera: its pose, degrees along the width of the film, and width and height in pixels."""
    width, height = film
    return {
        "type": "perspective",
        "fov": field_of_view,
        "fov_axis": "x",
        "to_world": view,
        "film": {
            "type": "hdrfilm",
            "width": width,
            "height": height,
            "pixel_format": "rgb",
            "rfilter": {"type": "box"},
        },
    }


def rgb(*color: float) -> dict[str, Any]:
    """Colour or grey as a dictionary of Mitsuba."""
    return {"type": "rgb", "value": list(color) if len(color) > 1 else color[0]}
