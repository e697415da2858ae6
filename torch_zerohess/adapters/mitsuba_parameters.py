"""What a column of x may change in a Mitsuba scene: the pose of objects (`Transform`), or values (`Value`)."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np

from torch_zerohess.arguments import checked_number

Vector = Sequence[float]
Range = tuple[float, float]

_POSITIONS, _NORMALS = ".vertex_positions", ".vertex_normals"

_ACCEPTED: tuple[tuple[tuple[str, ...], Range], ...] = (
    (("reflectance", "transmittance", "albedo", "opacity", "weight"), (0.0, 1.0)),
    (("alpha", "alpha_u", "alpha_v", "roughness"), (1e-4, 1.0)),
    (("radiance", "intensity", "irradiance", "sigma_t", "scale"), (0.0, math.inf)),
    (("x_fov",), (1e-3, 179.0)),
)
"""Ranges outside of which Mitsuba renders nonsense or stops, by what the name of a value ends with."""


class Bound(Protocol):
    """A parameter of a scene that is loaded."""

    n: int
    names: tuple[str, ...]
    labels: list[str]
    x0: list[float]
    limits: list[Range]

    def write(self, values: Any, x: Any) -> None:
        """Give x, a list of n numbers, to the entries `names` of what `mitsuba.traverse` returned.

        A Dr.Jit array [n] instead of the list passes its derivatives on, in variants that have them.
        """


class Parameter(Protocol):
    """A part of x and of the scene."""

    @property
    def names(self) -> tuple[str, ...]: ...

    def bind(self, mi: Any, values: Any) -> Bound:
        """Look the parameter up in a scene that has its names."""


@dataclass(frozen=True)
class Transform:
    """Pose of a shape, an instance, an emitter or a sensor, relative to that in the scene.

    The pose is T(sum_i x_i unit_i move_i) P R(turn_1, x_j unit_j) ... P^-1 (pose in the scene), with P the translation
    to the pivot. A mesh has no `to_world`: name its `vertex_positions`, and its normals follow. Moving an instance of a
    shape group is faster, since a mesh writes all vertices. Wherever several numbers are asked for, a list, an array of
    NumPy or a tensor will do.

    Args:
        name: of a `to_world` or of `vertex_positions`, or several that move together.
        move: directions [m][3].
        turn: axes of rotations [r][3].
        unit: length or degrees of x = 1, one for all or one for each of the m + r columns.
        bounds: of x, a pair for all or one for each; None for none.
        pivot: point that stays where it is when turned; None for the origin of the (first) object, or for the centre of
            the box around it if it is a mesh.
    """

    name: str | tuple[str, ...]
    move: Sequence[Vector] = ()
    turn: Sequence[Vector] = ()
    unit: float | Sequence[float] = 1.0
    bounds: Range | Sequence[Range] | None = None
    pivot: Vector | None = None

    @property
    def names(self) -> tuple[str, ...]:
        return (self.name,) if isinstance(self.name, str) else tuple(self.name)

    def bind(self, mi: Any, values: Any) -> "Pose":
        first, unit = self.names[0], plain(self.unit)
        move, turn = (_vectors(f"{first}: {what}", plain(getattr(self, what))) for what in ("move", "turn"))
        n = len(move) + len(turn)
        if n == 0:
            raise ValueError(f"{first}: move and turn must have at least one vector, got none")
        pivot = None if self.pivot is None else _vector(f"{first}: pivot", "a point", plain(self.pivot))
        for name in self.names:
            kind = type(values[name]).__name__
            if "Transform4f" not in kind and not name.endswith(_POSITIONS):
                raise ValueError(f"Transform is for a to_world or vertex_positions, but {name} is a {kind}: take Value")
        units = [checked_number(f"{first}: unit", one) for one in (unit if _several(unit) else [unit] * n)]
        if len(units) != n or not all(math.isfinite(one) and one != 0.0 for one in units):
            raise ValueError(f"{first}: unit must be a number or {n} numbers, not 0, got {unit!r}")
        return Pose(replace(self, move=move, turn=turn, pivot=pivot), mi, values, units)


class Pose:
    """A `Transform` of a loaded scene."""

    def __init__(self, transform: Transform, mi: Any, values: Any, units: list[float]) -> None:
        first = transform.names[0]
        self.n, self._mi, self._units = len(units), mi, units
        self._moves = transform.move
        self._turns = [[c / math.hypot(*one) for c in one] for one in transform.turn]  # of length 1
        self._objects = [(_Mesh if one.endswith(_POSITIONS) else _Frame)(one, mi, values) for one in transform.names]
        self.names = tuple(name for one in self._objects for name in one.names)
        self._pivot = [float(c) for c in (self._objects[0].origin if transform.pivot is None else transform.pivot)]
        kinds = [f"move{i}" for i in range(len(self._moves))] + [f"turn{i}" for i in range(len(self._turns))]
        self.labels = [f"{first}.{kind}" for kind in kinds]
        self.x0 = [0.0] * self.n
        self.limits = ranges(first, transform.bounds, self.n)

    def write(self, values: Any, x: Any) -> None:
        numbers = isinstance(x, list)
        pose = self._mi.ScalarTransform4f() if numbers else self._mi.Transform4f()  # the latter carries derivatives
        x = x if numbers else elements(self._mi, x, self.n)
        moved = len(self._moves)
        if moved:
            steps = [(u * value, move) for u, value, move in zip(self._units, x, self._moves, strict=False)]
            pose = pose.translate([sum(length * move[c] for length, move in steps) for c in range(3)])
        if self._turns:
            pose = pose.translate(self._pivot)
            for unit, value, axis in zip(self._units[moved:], x[moved:], self._turns, strict=True):
                pose = pose.rotate(axis, unit * value)
            pose = pose.translate([-c for c in self._pivot])
        for one in self._objects:
            one.place(values, pose, numbers)


class _Frame:
    """A `to_world`."""

    def __init__(self, name: str, mi: Any, values: Any) -> None:
        self.names = (name,)
        matrix = np.array(values[name].matrix, np.float64).reshape(4, 4)
        self.origin = matrix[:3, 3]
        self._scalar = mi.ScalarTransform4f(matrix)

    def place(self, values: Any, pose: Any, numbers: bool) -> None:
        (name,) = self.names
        values[name] = type(values[name])(pose @ (self._scalar if numbers else type(pose)(self._scalar)))


class _Mesh:
    """Vertices [m, 3] in the scene, and unit normals if the mesh has them."""

    def __init__(self, name: str, mi: Any, values: Any) -> None:
        normals = name.removesuffix(_POSITIONS) + _NORMALS
        self._mi = mi
        self._arrays = {
            one: np.array(values[one], np.float64).reshape(-1, 3)
            for one in (name, normals)
            if one == name or (one in values and np.array(values[one]).size)
        }
        self.names = tuple(self._arrays)
        vertices = self._arrays[name]
        self.origin = 0.5 * (vertices.min(0) + vertices.max(0))

    def place(self, values: Any, pose: Any, numbers: bool) -> None:
        for name, array in self._arrays.items():
            directions = name.endswith(_NORMALS)  # rotations and translations: normals turn as vectors do
            if numbers:
                matrix = np.array(pose.matrix, np.float64).reshape(4, 4)
                moved = array @ matrix[:3, :3].T + (0.0 if directions else matrix[:3, 3])
                values[name] = type(values[name])(moved.astype(np.float32).ravel())
            else:
                import drjit

                kind = self._mi.Vector3f if directions else self._mi.Point3f
                values[name] = drjit.ravel(pose @ kind(array.T.astype(np.float32)))


@dataclass(frozen=True)
class Value:
    """A number, a colour, a texture or vertices: anything `mitsuba.traverse` lists that is made of real numbers.

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
                raise ValueError(f"Value is for real numbers, but {name} is a {type(values[name]).__name__}")
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
        takes = [accepted(name) for name in self.names]
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
            values[name] = kind(new)

    def _attached(self, x: Any, size: int) -> Any:
        """Elements from a Dr.Jit array x [n]."""
        if self.n < size:
            x = elements(self._mi, x, 1)[0] + self._mi.Float(np.zeros(size, np.float32))
        if self._tensor:
            return self._mi.TensorXf(self._unit * x, shape=self._shape)
        return self._unit * x if size == 1 or size > 4 else [self._unit * one for one in elements(self._mi, x, size)]


def elements(mi: Any, x: Any, n: int) -> list[Any]:
    """Dr.Jit numbers of a Dr.Jit array x [n]."""
    import drjit

    return [drjit.gather(mi.Float, x, i) for i in range(n)]


def accepted(name: str) -> Range:
    """Range of what Mitsuba takes for a value, from its name; infinite where nothing is known."""
    words = [word for word in name.split(".") if word not in ("value", "data")]
    for endings, limits in _ACCEPTED:
        if words and any(words[-1] == ending or words[-1].endswith("_" + ending) for ending in endings):
            return limits
    return -math.inf, math.inf


def ranges(name: str, bounds: Range | Sequence[Range] | None, n: int) -> list[Range]:
    """Return n pairs of a lower and an upper bound."""
    if bounds is None:
        return [(-math.inf, math.inf)] * n
    given: Any = plain(bounds)
    several = given if _several(given) and any(_several(one) for one in given) else [given] * n
    if len(several) != n or not all(_several(one) and len(one) == 2 for one in several):
        raise ValueError(f"bounds of {name} must be a pair (lower, upper) or {n} of them, got {given!r}")
    low_high = [[checked_number(f"bounds of {name}", end) for end in one] for one in several]
    pairs = [(low, high) for low, high in low_high]
    for low, high in pairs:
        if not low < high:
            raise ValueError(f"bounds of {name} must be lower < upper, got {low:g}, {high:g}")
    return pairs


def plain(value: Any) -> Any:
    """Return arrays and tensors as numbers or lists of numbers; also those in a list, whose kind stays."""
    if hasattr(value, "tolist"):
        return value.tolist()
    if not hasattr(value, "__len__") or isinstance(value, (str, bytes, dict)):
        return value
    rows = [plain(one) for one in value]
    return tuple(rows) if isinstance(value, tuple) else rows


def _several(value: Any) -> bool:
    return isinstance(value, (list, tuple))


def _vectors(name: str, vectors: Any) -> list[list[float]]:
    """Return vectors [m][3], none of them 0."""
    if not _several(vectors):
        raise ValueError(f"{name} must be a list of vectors, got {vectors!r}")
    checked = [_vector(name, "vectors", one, ", not all 0") for one in vectors]
    for one in checked:
        if not any(one):
            raise ValueError(f"{name} must be vectors of 3 numbers, not all 0, got {one!r}")
    return checked


def _vector(name: str, what: str, vector: Any, more: str = "") -> list[float]:
    """Return 3 finite numbers."""
    if not _several(vector) or len(vector) != 3:
        raise ValueError(f"{name} must be {what} of 3 numbers{more}, got {vector!r}")
    return [checked_number(name, one, below=math.inf) for one in vector]
