"""Numbers in a Mitsuba scene as a part of x: colours, textures, vertices, and what Mitsuba accepts for each."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torch_zerohess.adapters.mitsuba_parameters import Range, assign, elements, plain, ranges
from torch_zerohess.arguments import checked_number

_ACCEPTED: tuple[tuple[tuple[str, ...], Range], ...] = (
    (("reflectance", "transmittance", "albedo", "opacity", "weight"), (0.0, 1.0)),
    (("alpha", "alpha_u", "alpha_v", "roughness"), (1e-4, 1.0)),
    (("radiance", "intensity", "irradiance", "sigma_t", "scale"), (0.0, math.inf)),
    (("x_fov",), (1e-3, 179.0)),
    (("base_color", "metallic", "specular", "spec_tint", "spec_trans", "clearcoat", "clearcoat_gloss"), (0.0, 1.0)),
    (("sheen", "sheen_tint", "flatness", "anisotropic"), (0.0, 1.0)),
    (("diff_trans",), (0.0, 2.0)),
)
"""Ranges outside of which Mitsuba renders nonsense or stops, by what the name of a value ends with."""

_OF_TEXTURES = "value", "data", "color0", "color1"
"""Ends of the names of textures, after the name of what the texture is for."""


@dataclass(frozen=True)
class Value:
    """A number, a colour, a texture or vertices: anything `mitsuba.traverse` lists that is made of real numbers.

    Mitsuba recomputes the normals of a mesh from the `vertex_positions` that it is given, also at x0: the mesh is then
    smooth where its file had other normals. Normals that are a `Value` of their own are not recomputed.

    Describe a bitmap of 8 or 16 bits with `"format": "variant"`. Mitsuba otherwise keeps 8 bits as integers, which are
    refused, and rounds 16 bits to half precision.

    Args:
        name: of a value, or several that share it.
        bounds: of x, a pair for all or one for each; None takes what the scene accepts, such as 0 to 1 for a
            reflectance.
        unit: value of x = 1.
        elements: 1 for one number that all elements share, such as a grey; None for all elements.
    """

    name: str | tuple[str, ...]
    bounds: Range | Sequence[Range] | None = None
    unit: float = 1.0
    elements: int | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return (self.name,) if isinstance(self.name, str) else tuple(self.name)

    def bind(self, mi: Any, values: Any) -> "Numbers":
        unit = checked_number(f"{self.names[0]}: unit", plain(self.unit))
        if not (math.isfinite(unit) and unit != 0.0):
            raise ValueError(f"{self.names[0]}: unit must be a number other than 0, got {self.unit!r}")
        if self.elements not in (None, 1):
            raise ValueError(f"{self.names[0]}: elements must be 1 or None, got {self.elements!r}")
        for name in self.names:
            if "Transform" in type(values[name]).__name__:
                raise ValueError(f"Value is for numbers, but {name} is a transform: take Transform")
            if np.array(values[name]).dtype.kind != "f":
                raise ValueError(
                    f"Value is for real numbers, but {name} is a {type(values[name]).__name__}"
                    + ': describe the bitmap with "format": "variant"' * name.endswith(".data")
                )
        shapes = {name: np.array(values[name]).size for name in self.names}
        if len(set(shapes.values())) > 1:
            raise ValueError(f"names that share a value must have the same size, got {shapes}")
        return Numbers(replace(self, unit=unit), mi, values)


class Numbers:
    """A `Value` of a loaded scene."""

    def __init__(self, value: Value, mi: Any, values: Any) -> None:
        self._mi, first = mi, value.names[0]
        now = np.array(values[first], np.float64)
        self.names, self._unit, self._shape = value.names, value.unit, now.shape
        self._kinds = [type(values[name]) for name in self.names]
        self._tensor = "Tensor" in self._kinds[0].__name__
        self.n = 1 if value.elements == 1 else now.size
        self.labels = [first] if self.n == 1 else [f"{first}[{i}]" for i in range(self.n)]
        flat = now.reshape(-1) / value.unit
        self.x0 = [float(flat.mean())] if self.n == 1 else flat.tolist()
        takes = [accepted(name, values) for name in self.names]
        ends = max(one for one, _ in takes) / value.unit, min(one for _, one in takes) / value.unit
        low, high = min(ends), max(ends)
        self.limits = ranges(first, (low, high) if value.bounds is None else value.bounds, self.n)
        for least, most in self.limits:
            if least < low or most > high:
                raise ValueError(
                    f"bounds of {first} must lie within {low:g} to {high:g}, which the scene accepts, "
                    f"got {least:g} to {most:g}"
                )

    def write(self, values: Any, x: Any) -> None:
        size = math.prod(self._shape)
        if not isinstance(x, list):
            new = self._attached(x, size)
        elif self._tensor or size > 4:  # textures, vertices
            full = np.full(size, self._unit) * np.asarray(x, np.float64)
            new = full.astype(np.float32).reshape(self._shape)
        else:
            new = [self._unit * one for one in x] * (size // len(x))
            new = new if size > 1 else new[0]
        for name, kind in zip(self.names, self._kinds, strict=True):
            assign(values, name, kind(new))

    def _attached(self, x: Any, size: int) -> Any:
        """Elements from a Dr.Jit array x [n]."""
        if self.n < size:
            x = elements(self._mi, x, 1)[0] + self._mi.Float(np.zeros(size, np.float32))
        if self._tensor:
            return self._mi.TensorXf(self._unit * x, shape=self._shape)
        return self._unit * x if size == 1 or size > 4 else [self._unit * one for one in elements(self._mi, x, size)]


def accepted(name: str, values: Any) -> Range:
    """Range of what Mitsuba takes for a value, from its name; infinite where nothing is known."""
    words = name.split(".")
    if words[-1] == "data" and ".".join([*words[:-1], "scale"]) in values:  # an environment map, named as one likes
        return 0.0, math.inf
    words = [word for word in words if word not in _OF_TEXTURES]
    for endings, limits in _ACCEPTED:
        if words and any(words[-1] == ending or words[-1].endswith("_" + ending) for ending in endings):
            return limits
    return -math.inf, math.inf
