"""A sphere outside the view whose shadow falls on a wall (task SHAD).

The wall is the plane x = 0 with a grid for a texture; the light is a point, so the shadow has a hard edge, which gives
no derivative to a renderer that does not sample it.
"""

from typing import Any

from experiments.problems.scenes.parts import camera, instance, rgb
from torch_zerohess.adapters.mitsuba import Transform

POSITION = Transform("ball.to_world", move=((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))
"""Two columns: y and z of the sphere, relative to the pose of the source."""
CAMERA, FIELD_OF_VIEW = 17.658, 39.6
BALL, LIGHT, POWER = (13.568, 8.049, -2.0), (25.975, 13.776, 0.0), 1715.0
SKY = (0.6, 0.6, 0.99)


def shadow(mi: Any, instances: bool = True) -> dict[str, Any]:
    """Return the scene for `mitsuba.load_dict`, its ball an instance or, for derivatives, a shape of its own."""
    pose = mi.ScalarTransform4f().translate(list(BALL))
    sphere = {"type": "sphere", "radius": 0.5, "bsdf": {"type": "diffuse"}}
    transform = mi.ScalarTransform4f
    view = transform().look_at(origin=[CAMERA, 0, 0], target=[0, 0, 0], up=[0, 0, 1])
    paper = {
        "type": "checkerboard",
        "color0": rgb(0.35),
        "color1": rgb(0.45),
        "to_uv": mi.ScalarTransform3f().scale([16, 16]),
    }
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 6, "rr_depth": 6},
        "sensor": camera(view, FIELD_OF_VIEW, (256, 192)),
        "wall": {
            "type": "rectangle",
            "to_world": transform().look_at(origin=[0, 0, 0], target=[1, 0, 0], up=[0, 0, 1]).scale(20),
            "bsdf": {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": paper}},
        },
        **(instance("ball", "group", sphere, pose) if instances else {"ball": {**sphere, "to_world": pose}}),
        "light": {"type": "point", "position": list(LIGHT), "intensity": rgb(POWER)},
        "sky": {"type": "constant", "radiance": rgb(*SKY)},
    }
