"""Gauss-Newton for the vertices of a mesh, from coarse to fine, by the public search for thousands of parameters.

| method | perturbed | derivatives of | step |
|---|---|---|---|
| levels_local | handles | every pixel, found from samples | Gauss-Newton |

*Handles* are the vertices of a coarser mesh, as in `mesh_handles`. Subdivision makes their displacements smooth, so
that no other prior on the mesh is needed. Each stage is one `zh.optim.LocalGaussNewton` over the handles of a level.
Samples tell which pixels a handle changes: no camera and no footprint is given.

Fine handles stretch triangles between the ears and the back into a dark web. Its two sides hide each other: the
silhouette changes only if both move. In two stages the handles are therefore points in space, each of which moves both.

The output is the image after two white-box operations. A *tone curve* raises dark pixels: shading is a quarter at
least where there is a mesh, and the background is 0. With the shading alone, a dark part that is missing is a small
error. Then pixels are averaged over small blocks, so that fewer outputs have less noise of triangles' edges.
"""

from typing import NamedTuple

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.mesh_handles import is_mesh
from experiments.methods.method import Method
from experiments.runs.trial import Trial

DARKEST = 0.25
"""Least brightness of a mesh, in front of a background of 0."""


class Stage(NamedTuple):
    """One search over the handles of a level."""

    level: int | None
    """Of the mesh whose vertices are the handles; None for handles in space."""
    evaluations: int
    """After which no further batch is asked for."""
    sigma: float
    """In units of the distance of the handles, for vertices the mean one at the start of the run."""
    block: int
    """Pixels along the side of the blocks that are averaged."""
    silhouette: float = 0.5
    """Share of the tone curve in the output; the rest is the image itself."""


STAGES = (
    Stage(1, 150, 0.2, 8),
    Stage(2, 550, 0.3, 4),
    Stage(None, 250, 0.3, 4, 0.7),
    Stage(3, 350, 0.3, 4, 0.6),
    Stage(None, 550, 0.3, 4, 0.9),
    Stage(3, 460, 0.25, 4, 0.9),
)
"""Chosen by hand on runs 1000 to 1013, as the defaults of `levels_local`."""
_APART = 0.2
"""Distance of handles in space, in units of the parameters."""


def levels_local(
    trial: Trial,
    *,
    stages: tuple[Stage, ...] = STAGES,
    keep: int = 20,
    samples: int = 48,
    least_sigma: float = 0.3,
    color: float = 0.5,
) -> None:
    """Search over the handles of one stage after the other, and end.

    Args:
        trial: the run.
        stages: from coarse to fine.
        keep: parameters per pixel, at most.
        samples: of an iteration; see `zh.optim.LocalGaussNewton`.
        least_sigma: share of the sigma of a stage below which no sample is drawn. Nearer samples move silhouettes by
            less than a pixel, so most pixels there do not change at all.
        color: change of a colour that counts as much as the distance of the handles.
    """
    task, mesh, x = trial.task, trial.task.mesh, trial.start
    assert mesh is not None
    assert task.output is not None
    assert task.output.residuals is not None
    black = torch.zeros_like(trial.image(x[None])[0])
    target = -task.output.residuals(black).view_as(black)
    for stage in stages:
        start = x
        if stage.level is None:
            handles, apart = mesh.lattice(start, _APART), _APART
        else:
            handles, apart = mesh.control(stage.level), mesh.spacing(trial.start, stage.level)
        unit = torch.tensor(3 * [apart] + (mesh.channels - 3) * [color], dtype=torch.float64)
        goal = toned(target[None], stage.silhouette, stage.block)[0]
        search = zh.optim.LocalGaussNewton(
            torch.zeros(len(handles) * mesh.channels, dtype=torch.float64),
            sigma=stage.sigma * unit.repeat(len(handles)),
            loss=zh.losses.mse(goal),
            keep=keep,
            samples=samples,
            least_sigma=least_sigma,
            restarts=task.evaluations,
            seed=trial.seed,
        )
        while search.evaluations < stage.evaluations and not search.done:
            z = search.ask()
            images = trial.image(handles.displaced(start, mesh.rows(z)))
            search.tell(toned(images, stage.silhouette, stage.block))
            x = handles.displaced(start, mesh.rows(search.x)[None])[0]
            trial.report(x, sigma=float(search.sigma * stage.sigma * apart), loss=search.value)


def toned(images: Tensor, silhouette: float, block: int) -> Tensor:
    """Images [K, v, side, side, ...] as one sheet each, [K, v * rows, columns, channels], after curve and blocks."""
    K, v, side = images.shape[:3]
    images = images.double()
    curve = (1.0 - silhouette) * images + silhouette * (images / DARKEST).clamp(max=1.0)
    planes = curve.reshape(K * v, side, side, -1).movedim(3, 1)
    blocks = torch.nn.functional.avg_pool2d(planes, block).movedim(1, 3)
    return blocks.reshape(K, -1, *blocks.shape[2:])


METHODS = (
    Method(
        "levels_local",
        "ours for meshes: Gauss-Newton on a sparse Jacobian, handles of a mesh from coarse to fine",
        with_settings(levels_local),
        is_mesh,
        ("scipy",),
        uses="image, triangles",
    ),
)
