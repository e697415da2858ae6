"""What a fitting task is: a black box, where its runs start, and how far a point is from the solution.

Tensors are float64. Points come in batches: x is [K, n], or [n] where one point is meant.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import torch
from torch import Tensor

if TYPE_CHECKING:
    from experiments.problems.scenes.fitted_mesh import FittedMesh


Preset = Literal["fast", "paper"]
"""Size of a task: "fast" takes minutes, "paper" has the sizes of the source."""


def _nothing(*_: int) -> None:
    """Do nothing, for `Renderer`. A function with a name can be pickled, a lambda cannot."""


@dataclass(frozen=True)
class Output:
    """The black box up to the white-box loss after it, for methods that use more than the loss.

    One point costs one evaluation, whether `Output.image` or `Task.loss` is called.
    """

    image: Callable[[Tensor], Tensor]
    """[K, n] -> [K, *out]."""
    loss: Callable[[Tensor], Tensor]
    """[*out] -> []; differentiable. `Task.loss` is `loss` of `image`."""
    residuals: Callable[[Tensor], Tensor] | None = None
    """[*out] -> [m] with loss = mean(residuals^2), for least-squares methods; None if the loss is another."""


@dataclass(frozen=True)
class Truth:
    """What is known of the solution. None of it is counted as an evaluation."""

    image_error: Callable[[Tensor], float]
    """Error of x [n] in the image."""
    parameter_error: Callable[[Tensor], float]
    """Mean squared error of x [n], up to symmetries of the task; NaN if there is no true point."""
    analytic: Callable[[Tensor, float], Tensor] | None = None
    """Differentiable loss [] of x [n], convolved with a Gaussian of the given sigma (0: the loss itself)."""
    measures: Callable[[Tensor], dict[str, float]] | None = None
    """Further measures of x [n], by name."""
    precision: float | None = None
    """Parameter error at which a run ends; a reduction by 99.9 % ends it if None."""


@dataclass(frozen=True)
class Picture:
    """What points look like: pictures [h, w] or [h, w, 3] in [0, 1]."""

    of: Callable[[Tensor], Tensor]
    """The picture of x [n]."""
    target: Callable[[], Tensor]
    """The picture that is sought."""


@dataclass(frozen=True)
class Renderer:
    """The program behind the black box: its own derivative, and when it is loaded and freed."""

    adjoint: Callable[[Tensor, str, int], tuple[Tensor, Tensor]] | None = None
    """x [n], one of `adjoints` and the seed of the adjoint pass -> loss [], gradient [n].
    Counts as two evaluations: a render and its adjoint."""
    adjoints: tuple[str, ...] = ()
    """Integrators that `adjoint` knows."""
    no_adjoint: Callable[[], str | None] = _nothing
    """Why `adjoint` cannot be called on this machine; None if it can."""
    prepare: Callable[[], None] = _nothing
    """Load what the black box needs, before the clock of a run starts."""
    release: Callable[[], None] = _nothing
    """Free the scene; the next call loads it again. Two loaded scenes slow each other down."""
    skip: Callable[[int, int], None] = _nothing
    """Advance fresh noise by so many calls and points, which a replay has answered without the renderer."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A black box of n parameters, with its start, solution, output and errors."""

    name: str
    title: str
    """What is sought, in one line."""
    parameters: str
    """Names, units and ranges."""
    needs: str
    """The part of the full setting that the loss depends on; the rest is left out."""
    n: int
    start: Callable[[int], Tensor]
    """Number of the run -> start [n], the same for every method. Runs from 1000 upward are for tuning."""
    sigma: float
    """Smoothing at the start, in units of the parameters: about the distance to the solution."""
    bounds: tuple[Tensor, Tensor] | None = None
    """Lower and upper [n]."""
    evaluations: int
    """Evaluations that a run may use."""
    loss: Callable[[Tensor], Tensor]
    """The black box with the loss: [K, n] -> [K]."""
    output: Output | None = None
    """None if the black box returns the loss only."""
    truth: Truth
    picture: Picture | None = None
    renderer: Renderer | None = None
    """None if the black box is a formula, with nothing to load."""
    mesh: "FittedMesh | None" = None
    """The cameras and triangles, which are known without a render, where the parameters are vertices of a mesh."""


def least_squares(image: Callable[[Tensor], Tensor], residuals: Callable[[Tensor], Tensor]) -> Output:
    """Output whose loss is mean(residuals^2)."""
    return Output(image, lambda out: residuals(out).square().mean(), residuals)


def differences_from(reference: Tensor) -> Callable[[Tensor], Tensor]:
    """Residuals of an output [*out], for `least_squares`: its differences from a reference [*out]."""
    return lambda out: (out - reference).flatten()


def assigned_error(x: Tensor, places: Tensor) -> float:
    """Mean squared error of interchangeable things x [m c] that are to be at places [m, c], least over assignments."""
    from scipy.optimize import linear_sum_assignment

    distance = (x.view(-1, 1, places.shape[1]) - places).square().sum(2)
    found, taken = linear_sum_assignment(distance.numpy())
    return float(distance[torch.from_numpy(found), torch.from_numpy(taken)].sum()) / len(x)


def uniform(lower: Tensor, upper: Tensor) -> Callable[[int], Tensor]:
    """Starts that are uniform between lower and upper [n], for `Task.start`."""

    def start(run: int) -> Tensor:
        generator = torch.Generator().manual_seed(run)
        return lower + (upper - lower) * torch.rand(len(lower), generator=generator, dtype=torch.float64)

    return start


def around(n: int, distance: float, spread: float) -> Callable[[int], Tensor]:
    """Starts whose n coordinates are uniform within `spread` of `distance` or of its negative, for `Task.start`."""

    def start(run: int) -> Tensor:
        generator = torch.Generator().manual_seed(run)
        size = distance + spread * (2 * torch.rand(n, generator=generator, dtype=torch.float64) - 1)
        return torch.where(torch.rand(n, generator=generator) < 0.5, -size, size)

    return start
