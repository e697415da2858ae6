"""MESHFIT, MESHFIT_COLOR, SUZANNE and BANANA: an icosphere of 2562 vertices becomes a mesh, from eight views of it.

MESHFIT's target is the Stanford bunny. SUZANNE and BANANA are tasks of the source, whose meshes are not given: see
`experiments.problems.scenes.mesh_targets`.

Parameters: x, y, z of every vertex, in units of the longest side of the target, of the bunny its height; n = 7686. With
colours (MESHFIT_COLOR, BANANA) red, green and blue of every vertex follow its position; n = 15372. Starts: a sphere of
radius U(0.40, 0.50) around a point within 0.05 of the origin in each coordinate, grey (0.5). Loss: mean squared
difference of eight images of 64x64 pixels from azimuths 45 degrees apart and elevations 30 and -10 degrees in turn, on
black. Sigma: 0.01, a fifth of the distance of neighbouring vertices.

The black box is a z-buffer of flat-shaded triangles with a lamp beside every camera (`scenes.raster`): no
shadows, no antialiasing, one sample per pixel; one channel is enough where the mesh is grey. The bunny is the scan in
the package pymeshfix with its vertices merged to about 5 000, or without this package a bunny of ellipsoids
(`experiments.problems.scenes.stanford`). The `paper` preset has images of 256x256 pixels.

Parameter error: there is no vertex of the target for one of the mesh, so it is the mean of the squared distances from
points of either surface (vertices and centres of triangles) to the nearest point of the other, in both directions: the
symmetric Chamfer distance. It ends at the distance of the points, 1e-4 or so. Measures: `silhouette_iou`, intersection
over union of the pixels that mesh and target cover, for every view.
"""

import math

import numpy as np
import numpy.typing as npt
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from experiments.problems.scenes.fitted_mesh import FittedMesh
from experiments.problems.scenes.mesh_targets import TARGETS, Target
from experiments.problems.scenes.raster import Cameras, render
from experiments.problems.task import Picture, Preset, Task, Truth, least_squares

VIEWS = 8
ELEVATIONS = (30.0, -10.0)
DISTANCE = 3.0
EXTENT = 0.66
"""Half of what the film sees at the distance of the origin: the bunny with a margin."""
LEVEL = 4
RADIUS = (0.40, 0.50)
OFFSET = 0.05

Array = npt.NDArray[np.float64]


class MeshFit:
    """The mesh that is fitted, the images it is fitted to, and how far it is from the target.

    Args:
        side: of the images in pixels.
        target: the mesh that is sought; the fitted mesh has colours if the target has.
    """

    def __init__(self, side: int, target: Target) -> None:
        cameras = Cameras.around(VIEWS, ELEVATIONS, DISTANCE, side, EXTENT)
        self.mesh = FittedMesh(cameras, LEVEL, 3 if target.colors is None else 6)
        corners, triangles = torch.from_numpy(target.vertices), torch.from_numpy(target.faces)
        painted = None if target.colors is None else torch.from_numpy(target.colors)[None]
        self.target = render(cameras, corners[None], triangles, painted)[0]
        """[v, side, side] or [v, side, side, 3]."""
        self._covered = render(cameras, corners[None], triangles)[0] > 0  # the shading is nowhere 0
        self._points = _spread(target.vertices, target.faces)
        self._tree = cKDTree(self._points)

    def start(self, run: int) -> Tensor:
        """A sphere [n]."""
        generator = torch.Generator().manual_seed(run)
        radius, *offset = torch.rand(4, generator=generator, dtype=torch.float64).unbind()
        rows = torch.full((len(self.mesh.sphere), self.mesh.channels), 0.5, dtype=torch.float64)
        size = RADIUS[0] + (RADIUS[1] - RADIUS[0]) * radius
        rows[:, :3] = size * self.mesh.sphere + OFFSET * (2 * torch.stack(offset) - 1)
        return rows.flatten()

    def residuals(self, images: Tensor) -> Tensor:
        """Differences [m] of images [v, side, side, ...] to the target."""
        return (images - self.target).flatten()

    def loss(self, x: Tensor) -> Tensor:
        """[K, n] -> [K]."""
        return (self.mesh.render(x).double() - self.target).square().flatten(1).mean(1)

    def chamfer(self, x: Tensor) -> float:
        """Mean of the squared distances from points of x [n] to the target and from the target to x."""
        points = _spread(self.mesh.rows(x)[:, :3].numpy(), self.mesh.faces.numpy())
        if not np.isfinite(points).all():
            return math.inf
        there, _ = self._tree.query(points)
        back, _ = cKDTree(points).query(self._points)
        return float(0.5 * ((there**2).mean() + (back**2).mean()))

    def silhouette_iou(self, x: Tensor) -> Tensor:
        """Intersection over union of the pixels that x [n] and the target cover, for every view [v]."""
        rows = self.mesh.rows(x)[None, :, :3]
        covered = render(self.mesh.cameras, rows, self.mesh.faces)[0] > 0
        both, any_ = (covered & self._covered).sum((1, 2)), (covered | self._covered).sum((1, 2))
        return both / any_

    def measures(self, x: Tensor) -> dict[str, float]:
        """Silhouette IoU of x [n] in every view, and the least of them."""
        views = self.silhouette_iou(x).tolist()
        return {"least silhouette IoU": min(views)} | {f"view {i + 1}": one for i, one in enumerate(views)}

    def picture(self, x: Tensor) -> Tensor:
        """Contact sheet of the views of x [n]."""
        return contact_sheet(self.mesh.render(x[None])[0])

    def task(self, name: str, title: str, parameters: str) -> Task:
        return Task(
            name=name,
            title=title,
            parameters=parameters,
            needs="silhouettes and shading of 8 small views: one sample per pixel, no shadows"
            + ("" if self.mesh.channels > 3 else ", one channel"),
            n=self.mesh.n,
            loss=self.loss,
            start=self.start,
            sigma=0.01,
            evaluations=20_000,
            output=least_squares(self.mesh.render, self.residuals),
            truth=Truth(lambda x: float(self.loss(x[None])[0]), self.chamfer, measures=self.measures),
            picture=Picture(self.picture, lambda: contact_sheet(self.target)),
            mesh=self.mesh,
        )


_SIDES = {"fast": 64, "paper": 256}


def task(preset: Preset = "fast") -> Task:
    return _fitted_to("meshfit", preset)


def meshfit_color(preset: Preset = "fast") -> Task:
    return _fitted_to("meshfit_color", preset)


def suzanne(preset: Preset = "fast") -> Task:
    return _fitted_to("suzanne", preset)


def banana(preset: Preset = "fast") -> Task:
    return _fitted_to("banana", preset)


def _fitted_to(name: str, preset: Preset) -> Task:
    """Return the task of fitting an icosphere to one of `TARGETS`."""
    target = TARGETS[name]()
    colored = target.colors is not None
    unit = "heights of the bunny" if "bunny" in target.name else "units of the longest side of the target"
    return MeshFit(_SIDES[preset], target).task(
        name,
        f"an icosphere{' and its colours' if colored else ''} fitted to eight views of {target.name}",
        f"x, y, z in {unit}{', red, green, blue in 0 to 1' if colored else ''} of 2562 vertices; "
        f"starts: {'grey ' if colored else ''}spheres of radius .4 to .5",
    )


def contact_sheet(images: Tensor) -> Tensor:
    """Views [v, h, w, ...] in two rows, as one picture."""
    return torch.cat([torch.cat(list(row), 1) for row in images.double().chunk(2)])


def _spread(vertices: Array, faces: npt.NDArray[np.integer]) -> Array:
    """Points on a surface: its vertices and the centres of its triangles."""
    return np.concatenate([vertices, vertices[faces].mean(1)])
