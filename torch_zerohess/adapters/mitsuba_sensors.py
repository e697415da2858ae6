"""The sensors of a loaded Mitsuba scene that are rendered, and parameters of those that are not."""

from collections.abc import Sequence
from typing import Any

Sensor = int | str
"""The number of a sensor, in the order of the scene, or its name."""


def chosen(scene: Any, sensor: Sensor | Sequence[Sensor]) -> list[Any]:
    """Return the sensors of a scene that are to be rendered.

    Raises RuntimeError for a scene without sensors, TypeError for what names no sensor, and ValueError for a sensor
    that the scene does not have, one that is given twice, and films of several sizes.
    """
    sensors = list(scene.sensors())
    if not sensors:
        raise RuntimeError("the scene has no sensor, and nothing can be rendered: add one to the description")
    wanted = [sensor] if isinstance(sensor, (int, str)) else sensor
    if not isinstance(wanted, Sequence) or not all(type(one) in (int, str) for one in wanted):
        raise TypeError(f"sensor must be a name, a number, or a list of these, got {sensor!r}")
    names = [one.id() for one in sensors]
    numbers = []
    for one in wanted:
        if one not in (range(len(sensors)) if isinstance(one, int) else names):
            known = ", ".join(_called(*pair) for pair in enumerate(sensors))
            raise ValueError(f"sensor must be one of {known}, got {one!r}")
        numbers.append(one if isinstance(one, int) else names.index(one))
    if not numbers or len({*numbers}) < len(numbers):
        raise ValueError(f"sensor must be different sensors, at least one, got {sensor!r}")
    found = [sensors[number] for number in numbers]
    sizes = [tuple(int(side) for side in one.film().crop_size()) for one in found]
    if len({*sizes}) > 1:
        named = ", ".join(f"{one!r}: {size}" for one, size in zip(wanted, sizes, strict=True))
        raise ValueError(f"films of several sensors must have one size, got (width, height) {named}: give film=")
    return found


def check_rendered(mi: Any, scene: Any, values: Any, rendered: Sequence[Any], names: Sequence[str]) -> None:
    """Raise ValueError if a name is a parameter of a sensor that is not rendered: it would change nothing.

    values: what `mitsuba.traverse` returned for the scene.
    """
    sensors = list(scene.sensors())
    numbers = [number for number, one in enumerate(sensors) if any(one is other for other in rendered)]
    if len(numbers) == len(sensors):
        return
    owners = {name: part[2] for name, part in values.properties.items()}  # the object that has a parameter
    kept = [*rendered, *(part[2] for one in rendered for part in mi.traverse(one).properties.values())]
    for name in names:
        if isinstance(owners[name], mi.Sensor) and not any(owners[name] is one for one in kept):
            shown = ", ".join(_called(number, sensors[number]) for number in numbers)
            raise ValueError(f"{name} is of a sensor that is not rendered; sensor renders {shown}")


def _called(number: int, sensor: Any) -> str:
    return f"{number} ({sensor.id()!r})" if sensor.id() else str(number)
