"""What a fitting task is: a black box, where its runs start, and how far a point is from the solution."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from experiments.problems.scenes.fitted_mesh import FittedMesh


def _nothing(*_: int) -> None:
    """For `Task.no_adjoint`, `prepare`, `release` and `skip`; a function with a name can be pickled."""


@dataclass(frozen=True)
class Task:
    """A black box of n parameters and the truth about it. Tensors are float64; points come in batches [K, n].

    The black box is there in two forms: `loss` returns one number per point, `image` what the loss is computed from,
    for methods that can use it. One point costs one evaluation in either form.
    """

    name: str
    title: str
    """What is sought, in one line."""
    parameters: str
    """Names, units and ranges."""
    needs: str
    """What of the full setting the loss depends on, and what is therefore left out."""
    n: int
    loss: Callable[[Tensor], Tensor]
    """[K, n] -> [K]."""
    start: Callable[[int], Tensor]
    """Number of the run -> start [n], the same for every method. Runs from 1000 upward are for tuning."""
    sigma: float
    """Smoothing at the start, in units of the parameters: of the order of the distance to the solution."""
    evaluations: int
    """Evaluations that a run may use."""
    image_error: Callable[[Tensor], float]
    """Error of x [n] in the image; not counted as an evaluation."""
    parameter_error: Callable[[Tensor], float]
    """Mean squared error of x [n], up to symmetries of the task."""
    bounds: tuple[Tensor, Tensor] | None = None
    """Lower and upper [n]."""
    image: Callable[[Tensor], Tensor] | None = None
    """[K, n] -> [K, *out]."""
    image_loss: Callable[[Tensor], Tensor] | None = None
    """White box after `image`: [*out] -> []; differentiable, a mean of squares of `residuals`."""
    residuals: Callable[[Tensor], Tensor] | None = None
    """[*out] -> [m] with image_loss = mean(residuals^2), for least-squares methods."""
    analytic: Callable[[Tensor, float], Tensor] | None = None
    """Differentiable loss of x [n] convolved with a Gaussian of the given sigma (0: the loss itself), where known."""
    picture: Callable[[Tensor], Tensor] | None = None
    """What x [n] looks like: [h, w] or [h, w, 3] in [0, 1]."""
    target_picture: Callable[[], Tensor] | None = None
    adjoint: Callable[[Tensor, str, int], tuple[Tensor, Tensor]] | None = None
    """The renderer's own derivative: x [n], one of `adjoints` and a seed of the adjoint pass -> loss [], gradient [n].
    Counts as two evaluations, a render and its adjoint."""
    adjoints: tuple[str, ...] = ()
    """Integrators that `adjoint` knows."""
    no_adjoint: Callable[[], str | None] = _nothing
    """Why `adjoint` cannot be called here, None if it can: derivatives need a variant of the renderer that has them."""
    prepare: Callable[[], None] = _nothing
    """Loads what the black box needs, before the clock of a run starts."""
    skip: Callable[[int, int], None] = _nothing
    """Lets a black box whose noise is fresh in every call go on as after so many calls and points, for runs that go on
    after a kill."""
    release: Callable[[], None] = _nothing
    """Frees what the black box has loaded, to be loaded again when it is called: scenes of a process slow each other
    down."""
    full: "Callable[[], Task] | None" = None
    """The same task with film, samples, depth and channels of the source, to measure what leaving them out saves."""
    mesh: "FittedMesh | None" = None
    """Where the parameters are the vertices of a mesh: its cameras and triangles, which are known without a render."""
    measures: Callable[[Tensor], dict[str, float]] | None = None
    """What else there is to know about x [n], by name."""
    precision: float | None = None
    """Parameter error that a run should reach beyond the usual levels, where the task is about reaching it."""


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
