"""Methods for the vertices of a mesh: smoothed derivatives, with knowledge of meshes and cameras around them.

`handles_newton` perturbs handles, and estimates derivatives of the losses of the handles. Its first steps are Newton
steps with a Hessian per handle, later steps are steps of Adam.

*Handles* are the vertices of a coarser mesh. Subdivision makes their displacements smooth. A run begins with few
handles and goes on with more.

*The loss of a handle* is the loss of the pixels that the handle can change: a box in every view, around the vertices
that it moves. The boxes follow from the cameras, which are known; they take no render. All handles are perturbed in the
same images. Each is a black box of its own few parameters, so that a few images determine its gradient and Hessian.
Other handles that change the same pixels add noise; changes elsewhere do not.

The gradients of the handles together are the gradient of the whole loss, with two differences: the faint ends of the
bumps are cut off, and the smoothing over the other handles has the density of their samples. The Hessians are the
diagonal blocks of the Hessian of the whole loss.

A pixel that only mesh or only target covers counts as more than its difference in shading. With the difference alone, a
missing ear and a dark web beside an ear are local minima.
"""

from collections.abc import Callable

import torch
from torch import Tensor

import torch_zerohess as zh
from experiments.methods.keywords import with_settings
from experiments.methods.method import Method
from experiments.problems.scenes.fitted_mesh import Control, FittedMesh
from experiments.problems.task import Task
from experiments.runs.trial import Trial

LEVELS = (1, 2, 3, 3, 4)
"""Of the icosphere, whose vertices are the handles in turn."""
BEYOND = 2.0
"""Margin of the box of a handle in units of sigma, for what its perturbations reach; 1 pixel comes on top."""
DAMPING = 0.5
"""Added to the eigenvalues of the blocks, in units of their mean size: a handle that is hardly seen hardly moves."""


def handles(
    trial: Trial,
    *,
    newton: int = 2,
    levels: tuple[int, ...] = LEVELS,
    steps: int = 80,
    samples: int = 8,
    sigma: tuple[float, float] = (0.1, 0.05),
    color: float = 0.5,
    rate: float = 0.3,
    size: float = 0.5,
    momentum: tuple[float, float] = (0.5, 0.95),
    silhouette: float = 1.0,
) -> None:
    """Descend with the handles of one level after the other, and end.

    Args:
        trial: the run.
        newton: number of levels, from the first, with Newton steps by blocks of the Hessian; the other levels have Adam
            steps. The finer the level, the fewer pixels a handle has, and the more of its sampled curvature is noise.
        levels: of the handles; one may come again.
        steps: on each level.
        samples: antithetic pairs; a step costs twice as many evaluations.
        sigma: at the first and the last step of a level, in units of the mean distance of its handles at the start of
            the run.
        color: change of a colour that counts as much as this distance.
        rate: factor of a Newton step, which is then no longer than sigma: handles that overlap correct the same
            pixels, each as if it were alone.
        size: of a step of Adam, in units of sigma.
        momentum: shares of what was before in the means of the gradient and of the curvature.
        silhouette: added to the square of a pixel that only one of mesh and target covers. A thin part that is dark,
            or missing, is a small error of the shading and a local minimum of it.
    """
    mesh, x = _mesh(trial.task), trial.start
    first_order = zh.Smoothing(sigma=1.0, samples=samples, order=1, baseline="none")
    second_order = zh.Smoothing(sigma=1.0, samples=samples, baseline="mean")
    for visit, level in enumerate(levels):
        smoothing = second_order if visit < newton else first_order
        control, means = mesh.control(level), _Means(momentum)
        unit = torch.full((mesh.channels,), mesh.spacing(trial.start, level), dtype=torch.float64)
        unit[3:] = color
        zero = torch.zeros(len(control), mesh.channels, dtype=torch.float64)
        for number in range(steps):
            width = sigma[0] + (sigma[1] - sigma[0]) * number / max(steps - 1, 1)
            smoothing = smoothing.replace(sigma=width)
            reach = BEYOND * width * float(unit[0]) * mesh.cameras.pixels + 1
            local = _losses(trial, control, x, unit, reach, silhouette)
            estimate = zh.estimate(local, zero, smoothing, value="smoothed", joint=True)
            if visit < newton:
                move = _newton(*means(estimate.gradient, estimate.hessian()), rate, width)
            else:
                move = _adam(*means(estimate.gradient, estimate.gradient.square()), size * width)
            x = control.displaced(x, (move * unit)[None])[0]
            trial.report(x, sigma=width * float(unit[0]))


def _losses(
    trial: Trial, control: Control, x: Tensor, unit: Tensor, margin: float, silhouette: float
) -> Callable[[Tensor], Tensor]:
    """The losses of all handles, displacements [K, handles, channels] in units of `unit` -> [K, handles]."""
    sums, squared = control.sums(x, margin), _squared(trial.task, silhouette)
    return lambda z: sums(squared(trial.image(control.displaced(x, z * unit))))


def _squared(task: Task, silhouette: float) -> Callable[[Tensor], Tensor]:
    """Shares of the pixels in the loss: images [K, v, side, side, ...] -> [K, v, side, side]."""
    assert task.output is not None
    residuals, mesh = task.output.residuals, _mesh(task)
    assert residuals is not None

    def squared(images: Tensor) -> Tensor:
        differences = torch.vmap(residuals)(images)
        target = images[:1] - differences[:1].view_as(images[:1])  # exactly 0 where it is
        mistaken = mesh.covered(images) != mesh.covered(target)
        square = differences.square().unflatten(1, (*mistaken.shape[1:], -1)).sum(4)
        return (square + silhouette * mistaken) / images[0].numel()

    return squared


class _Means:
    """Exponential means of two series, without the bias of their first value."""

    def __init__(self, shares: tuple[float, float]) -> None:
        self._shares, self._sums, self._weights = shares, [torch.tensor(0.0), torch.tensor(0.0)], [0.0, 0.0]

    def __call__(self, *values: Tensor) -> tuple[Tensor, Tensor]:
        for i, (share, value) in enumerate(zip(self._shares, values, strict=True)):
            self._sums[i] = share * self._sums[i] + (1 - share) * value
            self._weights[i] = share * self._weights[i] + (1 - share)
        first, second = (one / weight for one, weight in zip(self._sums, self._weights, strict=True))
        return first, second


def _newton(gradient: Tensor, blocks: Tensor, rate: float, longest: float) -> Tensor:
    """Steps [handles, c] to the minima along the eigenvectors of blocks [handles, c, c], of absolute curvature."""
    curvature, vectors = torch.linalg.eigh(blocks)
    size = curvature.abs()
    size = (size + DAMPING * size.mean()).clamp(min=1e-300)
    move = -rate * (vectors @ ((vectors.mT @ gradient[..., None]) / size[..., None]))[..., 0]
    return move * (longest / move.norm(dim=1, keepdim=True).clamp(min=longest))


def _adam(gradient: Tensor, square: Tensor, size: float) -> Tensor:
    """Steps [handles, c]."""
    return -size * gradient / square.sqrt().clamp(min=1e-300)


def _mesh(task: Task) -> FittedMesh:
    assert task.mesh is not None
    return task.mesh


def is_mesh(task: Task) -> str | None:
    """Say why a task does not have the vertices of a mesh as its parameters."""
    if task.mesh is None:
        return "its parameters are not the vertices of a mesh that known cameras see"
    return None if task.output and task.output.residuals else "the black box returns no residuals"


METHODS = (
    Method(
        "handles_newton",
        "ours for meshes: Newton, then Adam, a loss per handle",
        with_settings(handles),
        is_mesh,
        ("scipy",),
        uses="image, cameras, triangles",
    ),
)
