"""Small Mitsuba scenes whose images are known in closed form."""

import math

import numpy as np

from experiments.problems.scenes import parts
from torch_zerohess.adapters.mitsuba_variants import variants

VARIANTS = [name for name, probe in variants().items() if probe.works]
WITHOUT_NOISE = {"type": "direct", "emitter_samples": 0, "bsdf_samples": 1}
"""Under a constant light, cosine-weighted directions give albedo times radiance in every sample."""
RADIANCE, REFLECTANCE = "lamp.emitter.radiance.value", "plane.bsdf.reflectance.value"


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def camera(mi, width=4, height=4):
    """At (0, 0, 3), looking at the origin: x to the right, y up; the square of half side 1 fills the image."""
    view = mi.ScalarTransform4f().look_at(origin=[0, 0, 3], target=[0, 0, 0], up=[0, 1, 0])
    return parts.camera(view, 2 * math.degrees(math.atan(1 / 3)), (width, height))


def lamp(mi):
    """A square that shines, wider than the view."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": camera(mi),
        "lamp": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(2),
            "emitter": {"type": "area", "radiance": rgb(0.2, 0.3, 0.4)},
        },
    }


def plane(mi):
    """A matt square before a sky of radiance (0.5, 1, 2)."""
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": camera(mi),
        "plane": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().scale(2),
            "bsdf": {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)},
        },
        "sky": {"type": "constant", "radiance": rgb(0.5, 1.0, 2.0)},
    }


def screen(mi):
    """A square with a 2x2 texture that shines and fills the view."""
    picture = mi.Bitmap(np.zeros((2, 2, 3), np.float32))
    texture = {"type": "bitmap", "bitmap": picture, "raw": True, "filter_type": "nearest"}
    return {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": camera(mi),
        "screen": {"type": "rectangle", "emitter": {"type": "area", "radiance": texture}},
    }
