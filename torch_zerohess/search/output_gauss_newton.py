"""Gauss-Newton for an output under a known loss, by interpolation in a trust region.

The Jacobian at the best point is that of quadratics through the nearest evaluations, one per output
(`LeastNorm`). With the gradient and the Hessian of the loss it gives a quadratic of the loss, which is minimised within
the region. The Hessian has the curvature of the outputs where that predicted the last step better. Where steps achieve
what the quadratic promises, this converges fast. Where they do not, the method fails, and says so. Steps that are
shorter than the tolerance and achieve nothing are an arrival: an adaptive solver rounds its outputs to 1e-8, say.

Source: Dennis, Gay and Welsch (1981), "An adaptive nonlinear least-squares algorithm" (NL2SOL), for the choice;
Cartis, Fiala, Marteau and Roberts (2019), "Improving the flexibility and robustness of model-based
derivative-free optimization solvers" (DFO-LS), for Gauss-Newton on interpolated outputs; Wild (2017), "Solving
derivative-free nonlinear least squares problems with POUNDERS", for quadratics of least norm.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search.descent_progress import DescentProgress
from torch_zerohess.search.gaussian_process_progress import ProcessProgress
from torch_zerohess.search.method import Settings
from torch_zerohess.search.region_descent import BAD, LONG, RegionDescent
from torch_zerohess.search.region_progress import RegionProgress, latest
from torch_zerohess.search.state import Best, Evaluated
from torch_zerohess.surrogates.least_change import LeastNorm
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.quadratic import coefficients

_PATIENCE = 5
"""Rejected steps in a row after which the method has failed."""
_HOLES = 3
"""Values in a row that are not finite, after which it has failed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputProgress(RegionProgress):
    """The progress of `OutputGaussNewton`; the metric stays the identity."""

    outputs: Tensor
    """Of the evaluations [P, m]."""
    curvature: Tensor
    """What the curvature of the outputs adds to the Hessian [n, n], in units of `size`."""
    curved: bool = False
    """Whether the quadratic has it."""
    curved_part: float = 0.0
    """Its part of the loss that is predicted at the end of the step."""
    short: int = 0
    """Rejected steps in a row that were shorter than the tolerance, to a minimum of the model within the region."""
    kept: bool = False
    """Whether a step has kept its promise since the method began, or began again."""
    failed: bool = False
    """Whether the model does not hold here."""

    def remembered(self, evaluated: Evaluated, capacity: int) -> "OutputProgress":
        """Add evaluations whose values are finite."""
        new = evaluated.those(evaluated.finite)
        known = super().remembered(new, capacity)
        outputs = self.outputs
        if new.outputs is not None and len(new):
            outputs = torch.cat([outputs, new.outputs]) if len(outputs) else new.outputs
        lost = 0 if bool(evaluated.needed.finite.all()) else self.lost + 1
        return replace(
            known,
            outputs=outputs[latest(torch.cat([self.points, new.points]), known.lowest.point, capacity)],
            shape=evaluated.shape,
            evaluations=self.evaluations + len(evaluated),
            lost=lost,
            failed=lost >= _HOLES,
        )


class OutputGaussNewton(RegionDescent[OutputProgress]):
    """A local search that ends when it has arrived or failed, and never starts again. The metric is the identity.

    Args:
        settings: of the search.
        capacity: evaluations that are kept.
        patience: rejected steps in a row after which it has failed if no step has kept its promise yet; `_PATIENCE`
            if None, and after a step that has.
    """

    progress = OutputProgress

    def __init__(self, settings: Settings, capacity: int, patience: int | None = None) -> None:
        super().__init__(settings, min(coefficients(settings.n), capacity), capacity)
        self._patience = _PATIENCE if patience is None else patience

    def taking_over(self, known: DescentProgress | ProcessProgress, lowest: Best, sigma: float) -> OutputProgress:
        """Return the progress at the best point of a round of another search, with a region of the radius sigma."""
        pool = known.pool
        assert pool.outputs is not None
        begun = self._begun(lowest).taking(known, "best", "evaluations", "iterations", "shape")
        return replace(begun, points=pool.points, values=pool.values, outputs=pool.outputs, sigma=sigma)

    def plan(self, known: OutputProgress, generator: torch.Generator) -> tuple[OutputProgress, Tensor]:
        known, points = super().plan(known, generator)
        if known.phase == "trial" and len(points):
            step = points[0] - known.lowest.point
            known = replace(known, curved_part=0.5 * known.size * float(step @ known.curvature @ step))
        return known, points

    def _begun(self, best: Best, **own: Any) -> OutputProgress:
        nothing = best.point.new_zeros(self._n, self._n)
        return super()._begun(best, outputs=nothing[:0, :0], curvature=nothing, **own)

    def _after_start(
        self, known: OutputProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[OutputProgress, Tensor]:
        """Try a step at once: n + 1 outputs tell a Jacobian."""
        if len(known.values) <= self._n or bool((known.values == known.values[0]).all()):
            return self._on_plateau(known, generator)
        return self.plan(known, generator)

    def _judged(self, known: OutputProgress, ratio: float) -> tuple[OutputProgress, Tensor | None]:
        known, bad = super()._judged(known, ratio)
        error = (ratio - 1.0) * known.promised  # predicted loss minus the loss at the end of the step
        other = error + (-known.curved_part if known.curved else known.curved_part)
        known = replace(known, curved=known.curved != (abs(other) < abs(error)))
        kept = known.kept or ratio >= BAD
        is_short = known.length < LONG and known.length * known.sigma < self.settings.tolerance
        short = known.short + is_short if known.rejected else 0
        known = replace(known, kept=kept, short=short)
        if known.rejected < (_PATIENCE if kept else self._patience):
            return known, bad
        if 2 * short <= known.rejected:
            return replace(known, failed=True), bad
        return replace(known, done=True, message="steps that are shorter than the tolerance achieve nothing"), bad

    def _modelled(self, known: OutputProgress) -> tuple[OutputProgress, int]:
        assert self.settings.loss is not None
        nearest = self._nearest(known, self._n + 1)
        center, others = known.outputs[nearest[0]], nearest[1:]
        outputs = LeastNorm.through(known.scaled[others], known.outputs[others] - center)
        expanded = loss_curvature(self.settings.loss, center.view(known.shape))
        slope = expanded.slope.flatten()
        gradient = outputs.jacobian @ slope / known.sigma
        size = float(gradient.abs().max()) or 1.0
        unit = known.sigma**2 * size
        hessian = outputs.jacobian @ expanded.products(outputs.jacobian.view(self._n, *known.shape)).mT / unit
        curvature = outputs.hessian(slope) / unit
        hessian = 0.5 * (hessian + hessian.mT) + (curvature if known.curved else 0.0)
        return replace(known, size=size, gradient=gradient / size, hessian=hessian, curvature=curvature), len(nearest)

    def _on_plateau(self, known: OutputProgress, generator: torch.Generator) -> tuple[OutputProgress, Tensor]:
        return replace(known, failed=True), known.points[:0]

    def _arrived(
        self, known: OutputProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[OutputProgress, Tensor]:
        return replace(known, done=known.lost == 0, failed=known.lost > 0, message=reason), known.points[:0]
