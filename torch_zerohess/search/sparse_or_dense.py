"""The choice between a dense and a sparse model of the output, by how well each predicts held-out samples.

The first batch has the points of the first batch of `Descent`, in two parts. The search goes on as `LocalGaussNewton`
if the sparse Jacobian predicts more of the change of held-out samples than the dense Jacobian of least norm does, by
`_MORE`. After the first part it must also predict more than `_MOST` of it. Otherwise it goes on as `Descent` with all
evaluations, and asks for the points that `Descent` alone would ask for. Where the whole batch determines a dense
Jacobian, `_DETERMINED` takes the place of these limits: what a part of the batch predicts says little of it.

A few dozen samples may not tell: a support that is large, or a weak dense part beside a sparse one. So both Jacobians
are fitted again to all evaluations each time that these have doubled, until they are twice the parameters or too many
to be kept. The search changes if the Jacobian of the other one predicts more, by `_MORE`. To change to a sparse
Jacobian, this must also predict more than `_MOST`.
"""

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.search.descent.of_output import OutputDescent, OutputDescentProgress
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.relay import Relay
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated, Progress
from torch_zerohess.search.sparse.method import SparseMethod
from torch_zerohess.search.sparse.progress import SparseProgress
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES

FEWEST = 20
"""Parameters from which on a sparse Jacobian may need fewer samples than a dense one."""
_FIRST = 32
"""Samples of the first part, at most."""
_MOST = 0.5
"""Share of the held-out change from which on a sparse Jacobian is chosen for good: early, or in place of descent."""
_DETERMINED = 0.7, 0.9
"""These replace `_MOST` if the first batch has more points than there are parameters, so that it determines a dense
Jacobian: the first number after the first part of the batch, the second number after all of it."""
_MORE = 0.1
"""Share by which one Jacobian must predict more than the other one."""
_HELD = 1 << 25
"""Numbers of points and outputs that are kept for another choice, at most."""


@dataclass(frozen=True, eq=False, kw_only=True)
class SparseOrDenseProgress(Progress):
    """All evaluations while the choice may change, and the progress of the chosen search."""

    chosen: Literal["", "descent", "local"] = ""
    """Empty before the first choice."""
    reason: str
    due: int = 0
    """Evaluations at which the choice is made again; 0 if it is final."""
    rest: Tensor
    """Points of the first batch that were not asked for yet [r, n]."""
    points: Tensor
    """Evaluated while the choice may change [K, n]."""
    losses: Tensor
    """[K]"""
    outputs: Tensor
    """[K, m]"""
    descent: OutputDescentProgress | None
    sparse: SparseProgress | None = None


class SparseOrDense(Relay[SparseOrDenseProgress]):
    """`OutputDescent` or `SparseMethod`, for outputs with a loss."""

    engine = "descent or local"
    progress = SparseOrDenseProgress

    def __init__(self, settings: Settings, sparse: SparseMethod) -> None:
        super().__init__(settings)
        self.descent, self.sparse = OutputDescent(settings), sparse

    def first(self, generator: torch.Generator) -> tuple[SparseOrDenseProgress, Tensor]:
        """Ask for the start and the first part of the samples."""
        descent, points = self.descent.first(generator)
        count = 1 + min(_FIRST, max(FEWEST_SAMPLES, self.settings.n // 2))
        none = points.new_empty(0)
        known = SparseOrDenseProgress(
            best=descent.best,
            center=descent.center,
            reason="the first samples are to show whether outputs depend on few parameters each",
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
        if not known.chosen:
            return self._begun(_gathered(known, evaluated), generator)
        after, points = self._went_on(known, evaluated, generator)
        if not known.due or after.done:
            return after, points
        after = _gathered(after, evaluated)
        return (after, points) if len(after.losses) < known.due else self._chosen_again(after, points, generator)

    def _went_on(
        self, known: SparseOrDenseProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[SparseOrDenseProgress, Tensor]:
        """Let the chosen search go on."""
        if known.sparse is not None:
            sparse, points = self.sparse.next(known.sparse, evaluated, generator)
            return replace(known, sparse=sparse).taking(sparse), points
        assert known.descent is not None
        descent, points = self.descent.next(known.descent, evaluated, generator)
        return replace(known, descent=descent).taking(descent), points

    def _begun(self, known: SparseOrDenseProgress, generator: torch.Generator) -> tuple[SparseOrDenseProgress, Tensor]:
        """Choose by the first batch, or ask for the rest of it."""
        every = Evaluated(known.points, known.losses, known.outputs, known.shape)
        k = int(torch.where(torch.isfinite(known.losses), known.losses, torch.inf).argmin())
        known = replace(known, evaluations=len(every), best=Best(known.points[k], float(known.losses[k])))
        start = self.sparse.started(every)
        sparse, dense, reason = _predicted(start)
        whole, early = len(every) + len(known.rest), len(known.rest) > 0
        most = _DETERMINED[0 if early else 1] if whole > self.settings.n else _MOST if early else 0.0
        if start is not None and sparse > dense + _MORE and sparse > most:
            return self._to_sparse(known, start, reason, generator)
        if len(known.rest):
            return replace(known, rest=known.rest[:0]), known.rest
        assert known.descent is not None
        descent, points = self.descent.next(known.descent, every, generator)
        known = replace(known, chosen="descent", reason=reason, descent=descent).taking(descent)
        return self._decided(known, final=start is None), points

    def _chosen_again(
        self, known: SparseOrDenseProgress, points: Tensor, generator: torch.Generator
    ) -> tuple[SparseOrDenseProgress, Tensor]:
        """Choose by all evaluations around the best of them."""
        every = Evaluated(known.points, known.losses, known.outputs, known.shape)
        every = every.those(torch.where(every.finite, known.losses, torch.inf).argsort(stable=True))
        start = self.sparse.started(every) if bool(every.finite[0]) else None
        sparse, dense, reason = _predicted(start)
        if known.sparse is None and start is not None and sparse > max(dense + _MORE, _MOST):
            return self._to_sparse(known, start, reason, generator)
        jacobian = None if known.sparse is None else known.sparse.fitted
        if jacobian is not None and dense > max(jacobian.explained, sparse) + _MORE:
            descent, points = self.descent.taking_over(known, every, generator)
            known = replace(known, chosen="descent", reason=reason, descent=descent, sparse=None).taking(descent)
        return self._decided(known), points

    def _to_sparse(
        self, known: SparseOrDenseProgress, start: SparseProgress, reason: str, generator: torch.Generator
    ) -> tuple[SparseOrDenseProgress, Tensor]:
        """Go on by the sparse Jacobian."""
        begun = start.taking(known, "iterations").with_arrivals(rounds=known.rounds)
        sparse, points = self.sparse.asked(begun, generator)
        known = replace(known, chosen="local", reason=reason, descent=None, sparse=sparse).taking(sparse)
        assert start.fitted is not None
        return self._decided(known, final=start.fitted.explained > _MOST), points

    def _decided(self, known: SparseOrDenseProgress, *, final: bool = False) -> SparseOrDenseProgress:
        """Say when the choice is made again, or forget the evaluations: the chosen search has them."""
        count = len(known.losses)
        if final or count >= 2 * self.settings.n or known.points.numel() + known.outputs.numel() > _HELD:
            return replace(known, due=0, points=known.points[:0], losses=known.losses[:0], outputs=known.outputs[:0])
        return replace(known, due=2 * count)

    def more(self, known: SparseOrDenseProgress, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        return super().more(known, points, count, generator) if known.chosen else points[:0]

    def turn(self, known: SparseOrDenseProgress) -> tuple[Method[Any], Any]:
        return (self.descent, known.descent) if known.sparse is None else (self.sparse, known.sparse)


def _predicted(start: SparseProgress | None) -> tuple[float, float, str]:
    """Return the shares of the held-out change that a sparse and a dense Jacobian predict, and both in words."""
    if start is None or start.fitted is None:
        return 0.0, 0.0, "a sparse Jacobian predicts nothing: the output is one number, or too few outputs are finite"
    sparse, dense = start.fitted.explained, max(start.fitted.explained_dense, 0.0)
    words = (
        f"a sparse Jacobian predicts {max(sparse, 0.0):.0%} of the change of held-out outputs, a dense one {dense:.0%}"
    )
    return sparse, dense, words


def _gathered(known: SparseOrDenseProgress, evaluated: Evaluated) -> SparseOrDenseProgress:
    """Add what was evaluated."""
    assert evaluated.outputs is not None
    # A copy: the caller may use the memory of the outputs again.
    outputs = torch.cat([known.outputs, evaluated.outputs]) if len(known.outputs) else evaluated.outputs.clone()
    losses = torch.cat([known.losses, evaluated.losses])
    points = torch.cat([known.points, evaluated.points])
    return replace(known, points=points, losses=losses, outputs=outputs, shape=evaluated.shape)
