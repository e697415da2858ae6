"""A square poster seen at a slant, whose texture is sought (task POSTER).

The poster is all that is in view, on black. Its light comes from one direction, so that a render is linear in the
texture and has no noise but the noise of its pixels' samples.
"""

import math
from typing import Any

import numpy as np

from experiments.problems.scenes.parts import camera, rgb
from torch_zerohess.adapters.mitsuba import Value

SIDE = 32
"""Texels along each side of the texture."""
TEXTURE = Value("poster.bsdf.reflectance.data")
"""1024 columns: reflectance of the texels, row by row from below, 0 to 1."""
DISTANCE, AROUND, ABOVE, FIELD_OF_VIEW = 3.0, 40.0, 25.0, 46.0
"""Of the camera from the middle of the poster, in half sides of the poster, and its angles in degrees."""


def poster(mi: Any) -> dict[str, Any]:
    """Return the scene for `mitsuba.load_dict`, the texture grey."""
    turn, tilt = math.radians(AROUND), math.radians(ABOVE)
    origin = (math.sin(turn) * math.cos(tilt), math.sin(tilt), math.cos(turn) * math.cos(tilt))
    view = mi.ScalarTransform4f().look_at(origin=[DISTANCE * one for one in origin], target=[0, 0, 0], up=[0, 1, 0])
    grey = mi.Bitmap(np.full((SIDE, SIDE, 1), 0.5, np.float32))
    texture = {"type": "bitmap", "bitmap": grey, "raw": True, "filter_type": "bilinear", "wrap_mode": "clamp"}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": camera(view, FIELD_OF_VIEW, (96, 96)),
        "poster": {"type": "rectangle", "bsdf": {"type": "diffuse", "reflectance": texture}},
        "light": {"type": "directional", "direction": [0, 0, -1], "irradiance": rgb(math.pi)},
    }
