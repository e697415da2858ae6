"""The pose of objects in a Mitsuba scene as a part of x."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from torch_zerohess.adapters.mitsuba_parameters import (
    NORMALS,
    POSITIONS,
    Range,
    Vector,
    assign,
    elements,
    is_list,
    plain,
    ranges,
)
from torch_zerohess.arguments import checked_number


@dataclass(frozen=True)
class Transform:
    """Pose of a shape, an instance, an emitter or a sensor, relative to that in the scene.

    The pose is T(sum_i x_i unit_i move_i) P R(turn_1, x_j unit_j) ... P^-1 (pose in the scene), with P the translation
    to the pivot. A mesh has no `to_world`: name its `vertex_positions`. Its normals follow, so a `Value` cannot change
    them as well. Moving an instance of a shape group is faster, since a mesh writes all vertices. Wherever several
    numbers are asked for, a list, an array of NumPy or a tensor will do.

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
            if "Transform4f" not in kind and not name.endswith(POSITIONS):
                raise ValueError(f"Transform is for a to_world or vertex_positions, but {name} is a {kind}: take Value")
        units = [checked_number(f"{first}: unit", one) for one in (unit if is_list(unit) else [unit] * n)]
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
        self._objects = [(_Mesh if one.endswith(POSITIONS) else _Frame)(one, mi, values) for one in transform.names]
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
        normals = name.removesuffix(POSITIONS) + NORMALS
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
            directions = name.endswith(NORMALS)  # rotations and translations: normals turn as vectors do
            if numbers:
                matrix = np.array(pose.matrix, np.float64).reshape(4, 4)
                moved = array @ matrix[:3, :3].T + (0.0 if directions else matrix[:3, 3])
                assign(values, name, type(values[name])(moved.astype(np.float32).ravel()))
            else:
                import drjit

                kind = self._mi.Vector3f if directions else self._mi.Point3f
                assign(values, name, drjit.ravel(pose @ kind(array.T.astype(np.float32))))


def _vectors(name: str, vectors: Any) -> list[list[float]]:
    """Return vectors [m][3], none of them 0."""
    if not is_list(vectors):
        raise ValueError(f"{name} must be a list of vectors, got {vectors!r}")
    checked = [_vector(name, "vectors", one, ", not all 0") for one in vectors]
    for one in checked:
        if not any(one):
            raise ValueError(f"{name} must be vectors of 3 numbers, not all 0, got {one!r}")
    return checked


def _vector(name: str, what: str, vector: Any, more: str = "") -> list[float]:
    """Return 3 finite numbers."""
    if not is_list(vector) or len(vector) != 3:
        raise ValueError(f"{name} must be {what} of 3 numbers{more}, got {vector!r}")
    return [checked_number(name, one, below=math.inf) for one in vector]
