"""Closed surfaces of blended ellipsoids, seen from a point inside: stand-ins for meshes that are not installed."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from experiments.problems.scenes.icosphere import Index, icosphere

Array = npt.NDArray[np.float64]
Ellipsoid = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Centre and half axes."""
LEVEL = 5
"""Of the icosphere whose vertices are the directions."""


def blend(ellipsoids: Sequence[Ellipsoid], origin: tuple[float, float, float]) -> tuple[Array, Index]:
    """How far the blended ellipsoids reach from a point inside, up to 1, in the directions of an icosphere.

    Returns: vertices [m, 3] and triangles [k, 3], counterclockwise as seen from outside.
    """
    directions, faces = icosphere(LEVEL)
    start = np.array(origin)
    reach = np.linspace(0.0, 1.0, 201)[1:]
    field = np.zeros((len(directions), len(reach)))
    for centre, axes in ellipsoids:
        ray, offset = directions / axes, (start - centre) / axes
        square = (ray**2).sum(1)[:, None] * reach**2 + 2 * (ray @ offset)[:, None] * reach + offset @ offset
        field += np.exp(4.0 * (1.0 - square))  # 1 on the ellipsoid
    last = len(reach) - 1 - np.argmax(field[:, ::-1] >= 1.0, axis=1)
    rows = np.arange(len(directions))
    inside, outside = np.log(field[rows, last]), np.log(field[rows, np.minimum(last + 1, len(reach) - 1)])
    exact = reach[last] + (reach[1] - reach[0]) * inside / (inside - outside)
    return start + exact[:, None] * directions, faces
