"""A mesh whose vertices are the parameters of a black box: geometry that needs no render.

The parameters are, vertex by vertex, x, y, z, and red, green, blue where the mesh has colours.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from experiments.problems.scenes.icosphere import icosphere
from experiments.problems.scenes.raster import Cameras, render
from experiments.problems.scenes.subdivision import bumps

_FAINT = 0.01
"""Share of a displacement that counts as none."""
_REACHED = 0.02
"""Share of its displacement from which on a handle in space reaches the mesh."""


@dataclass(frozen=True)
class FittedMesh:
    """An icosphere of some level, deformed, seen by cameras that are known.

    Args:
        cameras: the views.
        level: of the icosphere.
        channels: parameters of a vertex, 3 or, with colours, 6.
    """

    cameras: Cameras
    level: int
    channels: int = 3

    @cached_property
    def sphere(self) -> Tensor:
        """Unit vertices [m, 3]."""
        return torch.from_numpy(icosphere(self.level)[0])

    @cached_property
    def faces(self) -> Tensor:
        """Triangles [k, 3]."""
        return torch.from_numpy(icosphere(self.level)[1])

    @property
    def n(self) -> int:
        return len(self.sphere) * self.channels

    def rows(self, x: Tensor) -> Tensor:
        """Parameters [*batch, n] by vertex, [*batch, m, channels]."""
        return x.unflatten(-1, (-1, self.channels))

    def render(self, x: Tensor) -> Tensor:
        """Views of the meshes x [K, n], [K, v, side, side] or with colours [K, v, side, side, 3], float32."""
        rows = self.rows(x)
        return render(self.cameras, rows[..., :3], self.faces, rows[..., 3:] if self.channels > 3 else None)

    def covered(self, images: Tensor) -> Tensor:
        """Pixels [*batch, v, side, side] of views that show a mesh: the background is 0, and shading is not."""
        shown = images != 0
        return shown if self.channels == 3 else shown.any(-1)

    def spacing(self, x: Tensor, level: int) -> float:
        """Mean length of the edges of x [n] between the vertices of a coarser level."""
        corners = self.rows(x)[self.faces, :3]
        return float((corners - corners.roll(1, 1)).norm(dim=2).mean()) * 2 ** (self.level - level)

    def control(self, level: int) -> "Control":
        """Return the vertices of a coarser level, as handles for bumps."""
        return Control(self, level)

    def lattice(self, x: Tensor, spacing: float) -> "Handles":
        """Return handles on a lattice in space around the mesh x [n], this far apart.

        A handle moves whatever is near it, also both sides of a thin sheet (free-form deformation: Sederberg and Parry
        1986), with the weights of cubic B-splines.
        """
        vertices = self.rows(x)[:, :3]
        first = vertices.amin(0) - spacing
        counts = ((vertices.amax(0) - first) / spacing).ceil().long() + 2
        along = [_cubic((vertices[:, k, None] - first[k]) / spacing - torch.arange(int(counts[k]))) for k in range(3)]
        weights = torch.einsum("ma,mb,mc->mabc", *along).flatten(1)
        return Handles(weights[:, weights.amax(0) > _REACHED])


def _cubic(distance: Tensor) -> Tensor:
    """Cubic B-spline at a distance in units of the spacing of its knots."""
    t = distance.abs()
    return torch.where(t < 1.0, 2.0 / 3.0 - t**2 + 0.5 * t**3, (2.0 - t).clamp(min=0.0) ** 3 / 6.0)


class Handles:
    """Points whose displacements move the vertices of a mesh.

    Args:
        matrix: [m, handles], share of the displacement of a handle that a vertex takes.
    """

    def __init__(self, matrix: Tensor) -> None:
        self.matrix = matrix

    def __len__(self) -> int:
        return self.matrix.shape[1]

    def displaced(self, x: Tensor, z: Tensor) -> Tensor:
        """Parameters [K, n] of the mesh x [n] with its handles displaced by z [K, handles, channels]."""
        return x + (self.matrix @ z).flatten(1)


class Control(Handles):
    """Displacements of the vertices of a coarser level, made smooth by subdivision.

    Args:
        mesh: the mesh.
        level: of the handles, at most the level of the mesh.
    """

    def __init__(self, mesh: FittedMesh, level: int) -> None:
        self._mesh = mesh
        matrix = bumps(level, mesh.level).toarray()
        super().__init__(torch.from_numpy(matrix))
        moved = [np.flatnonzero(column > _FAINT) for column in matrix.T]
        widest = max(map(len, moved))
        # Rows of one length: shorter ones are repeated, which changes no least or greatest coordinate.
        self._moved = torch.from_numpy(np.stack([np.resize(one, widest) for one in moved]))

    def sums(self, x: Tensor, margin: float) -> "BoxSums":
        """Return sums over what every handle can change of the views of x [n]: a box in every view.

        margin: around the vertices that it moves, in pixels.
        """
        column, row, _ = self._mesh.cameras.project(self._mesh.rows(x)[None, :, :3])
        side = self._mesh.cameras.side

        def between(place: Tensor) -> tuple[Tensor, Tensor]:
            moved = place[0][:, self._moved]
            first, end = (moved.amin(2) - margin).ceil(), (moved.amax(2) + margin).floor() + 1
            return first.clamp(0, side).long(), end.clamp(0, side).long()

        return BoxSums(*between(column), *between(row), side)


@dataclass(frozen=True)
class BoxSums:
    """Sums over boxes [v, handles] of columns left <= c < right and rows top <= r < bottom, from a table of sums."""

    left: Tensor
    right: Tensor
    top: Tensor
    bottom: Tensor
    side: int

    def __call__(self, images: Tensor) -> Tensor:
        """Sums over all views of images [K, v, side, side]: [K, handles]."""
        table = torch.nn.functional.pad(images.double().cumsum(2).cumsum(3), (1, 0, 1, 0)).flatten(1)
        view = torch.arange(len(self.left))[:, None] * (self.side + 1)

        def upto(row: Tensor, column: Tensor) -> Tensor:
            return table[:, ((view + row) * (self.side + 1) + column).flatten()].unflatten(1, self.left.shape)

        inside = upto(self.bottom, self.right) - upto(self.top, self.right)
        return (inside - upto(self.bottom, self.left) + upto(self.top, self.left)).sum(1)
