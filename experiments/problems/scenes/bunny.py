"""The Stanford bunny before a wall (task BUNNY), and seen through two mirrors only (task MIRROR).

Lengths are in units of the source, where the bunny is about one unit high; y is up.
"""

from dataclasses import replace
from typing import Any

from experiments.problems.scenes.parts import camera, instance, mi_mesh, rgb
from experiments.problems.scenes.stanford import bunny_surface
from torch_zerohess.adapters.mitsuba import Transform

TURN = 100.0
"""Degrees per unit of a rotation."""
_UP = (0.0, 1.0, 0.0)
OVER_WALL = Transform("bunny.to_world", move=((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)), turn=(_UP,), unit=(1.0, 1.0, TURN))
"""Three columns of BUNNY: x, z, and rotation in units of 100 degrees."""
IN_MIRRORS = Transform("bunny.to_world", move=((1.0, 0.0, 0.0), _UP), turn=(_UP,), unit=(1.0, 1.0, TURN))
"""Three columns of MIRROR: x, y, and rotation in units of 100 degrees."""
SEEN_AT = (-1.2, -0.1, -2.4)
"""The bunny of MIRROR."""
FUR, WALL = (0.65, 0.45, 0.3), (0.5, 0.55, 0.6)


def as_mesh(pose: Transform, pivot: tuple[float, float, float]) -> Transform:
    """The same columns for a bunny that is no instance, see `instances`."""
    return replace(pose, name="bunny.vertex_positions", pivot=pivot)


def over_wall(mi: Any, instances: bool = True) -> dict[str, Any]:
    """Return the scene of BUNNY for `mitsuba.load_dict`: bunny, wall with its shadow, one light."""
    transform = mi.ScalarTransform4f
    light = {"type": "area", "radiance": rgb(1000.0)}
    return {
        **_scene(
            mi, transform().look_at(origin=[0, 0, 2], target=[0, 0, 0], up=[0, 1, 0]), 60.0, (0.0, 0.0, 0.0), instances
        ),
        "wall": {
            "type": "rectangle",
            "to_world": transform().translate([0, 0, -2]).scale(10),
            "bsdf": {"type": "diffuse", "reflectance": rgb(*WALL)},
        },
        "light": {"type": "sphere", "center": [2.5, 2.5, 7.0], "radius": 0.25, "emitter": light},
    }


def in_mirrors(mi: Any, instances: bool = True) -> dict[str, Any]:
    """Return the scene of MIRROR for `mitsuba.load_dict`: the way to the eye is bunny, mirror 2, mirror 1."""
    transform = mi.ScalarTransform4f

    def mirror(at: tuple[float, ...], normal: tuple[float, ...], size: float) -> dict[str, Any]:
        target = [a + b for a, b in zip(at, normal, strict=True)]
        return {
            "type": "rectangle",
            "to_world": transform().look_at(origin=list(at), target=target, up=[0, 1, 0]).scale(size),
            "bsdf": {"type": "conductor"},
        }

    half = 0.5**0.5
    return {
        **_scene(
            mi, transform().look_at(origin=[1.5, 0, 2.2], target=[1.5, 0, 1.2], up=[0, 1, 0]), 18.0, SEEN_AT, instances
        ),
        "mirror1": mirror((1.5, 0.0, -0.6), (-half, 0.0, half), 1.0),
        "mirror2": mirror((-1.2, 0.0, -0.6), (half, 0.0, -half), 1.5),
        "sky": {"type": "constant", "radiance": rgb(0.25)},
        "light": {"type": "point", "position": [1.0, 2.5, 0.0], "intensity": rgb(14.0)},
    }


def _scene(mi: Any, view: Any, field_of_view: float, at: tuple[float, ...], instances: bool) -> dict[str, Any]:
    """Camera and bunny, an instance or, for derivatives, a mesh of the same name."""
    (vertices, normals, faces), _ = bunny_surface()
    fur = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": rgb(*FUR)}}
    mesh = mi_mesh(mi, "bunny", (vertices if instances else vertices + at, normals, faces), fur)
    pose = mi.ScalarTransform4f().translate(list(at))
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6, "rr_depth": 6},
        "sensor": camera(view, field_of_view, (64, 64)),
        **(instance("bunny", "group", mesh, pose) if instances else {"bunny": mesh}),
    }
