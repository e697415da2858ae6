"""The films of a loaded Mitsuba scene in another size, with the field of view that the scene was described with.

A perspective sensor holds its field of view along x, also if it was described along another axis (`fov_axis`, or
`focal_length` for the diagonal). A film with another aspect ratio then needs another field of view along x.
"""

import math
import os
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

Film = tuple[int, int]
"""Width and height in pixels."""


def resize(mi: Any, values: Any, film: Film, description: Mapping[str, Any] | str | os.PathLike[str]) -> None:
    """Give all films of a scene another size, and keep the fields of view along the axes that they were described for.

    values: what `mitsuba.traverse` returned for the scene.

    Raises ValueError if a film has a crop window.
    """
    names = list(values.keys())
    sizes = {name.removesuffix(".size"): _pair(values[name]) for name in names if name.endswith(".film.size")}
    for name, size in sizes.items():
        window, offset = _pair(values[f"{name}.crop_size"]), _pair(values[f"{name}.crop_offset"])
        if window != size or offset != (0, 0):
            raise ValueError(
                f"film must be None for a scene with a crop window, got {film}: {name} shows {window} pixels from "
                f"{offset} of {size}; describe the scene with the film that it should have, or without a window"
            )
        values[f"{name}.size"] = values[f"{name}.crop_size"] = list(film)
    axes = list(_axes(mi, description))
    for name in [one for one in names if one.endswith(".x_fov") and f"{one.removesuffix('.x_fov')}.film" in sizes]:
        sensor = name.removesuffix(".x_fov")
        axis = _taken(axes, sensor.split(".")[-1])
        old = float(np.array(values[name]).reshape(-1)[0])
        values[name] = type(values[name])(x_fov(old, axis, sizes[f"{sensor}.film"], film))
    values.update()


def x_fov(degrees: float, axis: str, old: Film, new: Film) -> float:
    """Return the field of view along x, in degrees, of a new film whose field of view along `axis` is that of the old.

    With L the length of a film along the axis and w its width: tan(new / 2) = tan(degrees / 2) (L / w) (w' / L').
    """
    if old[0] * new[1] == old[1] * new[0]:
        return degrees
    slope = math.tan(math.radians(degrees) / 2) * _length(axis, old) / old[0] * new[0] / _length(axis, new)
    return 2 * math.degrees(math.atan(slope))


def _length(axis: str, film: Film) -> float:
    return {"x": film[0], "y": film[1], "smaller": min(film), "larger": max(film), "diagonal": math.hypot(*film)}[axis]


def _axes(mi: Any, description: Any) -> Iterator[tuple[str, str]]:
    """Yield the name of each sensor that is described here, "" if it has none, and the axis of its field of view."""
    if isinstance(description, Mapping):
        for name, part in description.items():
            if isinstance(part, Mapping):
                yield part.get("id", name), _axis(part)
                yield from _axes(mi, part)
    elif hasattr(mi, "parser"):  # since Mitsuba 3.7
        config = mi.parser.ParserConfig(mi.variant())
        state = mi.parser.parse_file(config, str(description))
        mi.parser.transform_upgrade(config, state)  # older files have a fovAxis
        for node in state.nodes:
            if node.type == mi.ObjectType.Sensor:
                yield node.props.id(), _axis(node.props)


def _axis(sensor: Any) -> str:
    return "diagonal" if "focal_length" in sensor else sensor.get("fov_axis", "x").lower()


def _taken(axes: list[tuple[str, str]], name: str) -> str:
    """Return the axis of a sensor; of the next one without a name if it is not there, else "x"."""
    for wanted in (name, ""):
        for one in axes:
            if one[0] == wanted:
                axes.remove(one)
                return one[1]
    return "x"


def _pair(vector: Sequence[int]) -> Film:
    x, y = (int(one) for one in np.array(vector).reshape(-1))
    return x, y
