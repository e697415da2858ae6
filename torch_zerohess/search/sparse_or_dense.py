"""The choice between a dense and a sparse model of the output, by how well each predicts held-out samples.

The first batch has the points of the first batch of `Descent`, in two parts. The search goes on as `LocalGaussNewton`
if the sparse Jacobian predicts more of the change of held-out samples than the dense Jacobian of least norm does, by
`_MORE`. After the first part it must also predict more than `_MOST` of it. Otherwise it goes on as `Descent` with all
evaluations, and asks for the points that `Descent` alone would ask for.
"""

from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.search.local_method import LocalMethod
from torch_zerohess.search.local_progress import LocalProgress
from torch_zerohess.search.method import Method, Settings
from torch_zerohess.search.output_descent import OutputDescent, OutputDescentProgress
from torch_zerohess.search.relay import Relay
from torch_zerohess.search.state import Best, Evaluated, Progress
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES

FEWEST = 20
"""Parameters from which on a sparse Jacobian may need fewer samples than a dense one."""
_FIRST = 32
"""Samples of the first part, at most."""
_MOST = 0.5
"""Share of the held-out change that decides at once."""
_MORE = 0.1
"""Share by which the sparse Jacobian must predict more than the dense one."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SparseOrDenseProgress(Progress):
    """The evaluations before the choice; after the choice, the progress of the chosen search."""

    chosen: Literal["", "descent", "local"] = ""
    """Empty before the choice."""
    reason: str
    rest: Tensor
    """Points of the first batch that were not asked for yet [r, n]."""
    points: Tensor
    """Evaluated before the choice [K, n]."""
    losses: Tensor
    """[K]"""
    outputs: Tensor
    """[K, m]"""
    descent: OutputDescentProgress | None
    local: LocalProgress | None = None


class SparseOrDense(Relay[SparseOrDenseProgress]):
    """`OutputDescent` or `LocalMethod`, for outputs with a loss."""

    engine = "descent or local"
    progress = SparseOrDenseProgress

    def __init__(self, settings: Settings, local: LocalMethod) -> None:
        super().__init__(settings)
        self.descent, self.local = OutputDescent(settings), local

    def first(self, generator: torch.Generator) -> tuple[SparseOrDenseProgress, Tensor]:
        """Ask for the start and the first part of the samples."""
        descent, points = self.descent.first(generator)
        count = 1 + min(_FIRST, max(FEWEST_SAMPLES, self.settings.n // 2))
        none = points.new_empty(0)
        known = SparseOrDenseProgress(
            best=descent.best,
            center=descent.center,
            reason="the first samples are to tell whether outputs depend on few parameters each",
            rest=points[count:],
            points=points[:0],
            losses=none,
            outputs=none,
            descent=descent,
        )
        return known, points[:count]

    def next(
        self, known: SparseOrDenseProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[SparseOrDenseProgress, Tensor]:
        if known.chosen == "local":
            assert known.local is not None
            local, points = self.local.next(known.local, evaluated, generator)
            return replace(known, local=local).taking(local), points
        if known.chosen == "descent":
            assert known.descent is not None
            descent, points = self.descent.next(known.descent, evaluated, generator)
            return replace(known, descent=descent).taking(descent), points
        known = _gathered(known, evaluated)
        every = Evaluated(known.points, known.losses, known.outputs, known.shape)
        start = self.local.started(every)
        told = "nothing: the output is one number, or too few outputs are finite"
        if start is not None and start.jacobian is not None:
            sparse, dense = start.jacobian.explained, max(start.jacobian.explained_dense, 0.0)
            told = f"{max(sparse, 0.0):.0%} of the change of held-out outputs, a dense one {dense:.0%}"
            if sparse > dense + _MORE and (sparse > _MOST or not len(known.rest)):
                local, points = self.local.asked(start, generator)
                known = replace(_emptied(known), chosen="local", reason=f"a sparse Jacobian predicts {told}")
                return replace(known, local=local, descent=None).taking(local), points
        if len(known.rest):
            return replace(known, rest=known.rest[:0]), known.rest
        known = replace(_emptied(known), chosen="descent", reason=f"a sparse Jacobian predicts {told}")
        assert known.descent is not None
        descent, points = self.descent.next(known.descent, every, generator)
        return replace(known, descent=descent).taking(descent), points

    def more(self, known: SparseOrDenseProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        return super().more(known, points, count, generator) if known.chosen else points[:0]

    def turn(self, known: SparseOrDenseProgress) -> tuple[Method[Any], Any]:
        return (self.descent, known.descent) if known.local is None else (self.local, known.local)


def _gathered(known: SparseOrDenseProgress, evaluated: Evaluated) -> SparseOrDenseProgress:
    """Add what was evaluated."""
    assert evaluated.outputs is not None
    outputs = torch.cat([known.outputs, evaluated.outputs]) if len(known.outputs) else evaluated.outputs
    losses = torch.cat([known.losses, evaluated.losses])
    k = int(torch.where(torch.isfinite(losses), losses, torch.inf).argmin())
    points = torch.cat([known.points, evaluated.points])
    return replace(
        known,
        points=points,
        losses=losses,
        outputs=outputs,
        shape=evaluated.shape,
        evaluations=len(losses),
        best=Best(points[k], float(losses[k])),
    )


def _emptied(known: SparseOrDenseProgress) -> SparseOrDenseProgress:
    """Forget the batch that the search has been given."""
    return replace(known, points=known.points[:0], losses=known.losses[:0], outputs=known.outputs[:0])
