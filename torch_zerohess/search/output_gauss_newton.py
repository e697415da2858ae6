"""Gauss-Newton for an output under a known loss, by interpolation in a trust region.

The Jacobian at the best point is that of quadratics through the nearest evaluations, one per output
(`LeastNorm`). With the gradient and the Hessian of the loss it gives a quadratic of the loss, which is minimised within
the region. The Hessian has the curvature of the outputs where that predicted the last step better. Where steps achieve
what the quadratic promises, this converges fast. Where they do not, the method fails, and says so.

Source: Dennis, Gay and Welsch (1981), "An adaptive nonlinear least-squares algorithm" (NL2SOL), for the choice;
Cartis, Fiala, Marteau and Roberts (2019), "Improving the flexibility and robustness of model-based
derivative-free optimization solvers" (DFO-LS), for Gauss-Newton on interpolated outputs; Wild (2017), "Solving
derivative-free nonlinear least squares problems with POUNDERS", for quadratics of least norm.
"""

from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torch_zerohess.search.descent_progress import DescentProgress
from torch_zerohess.search.method import Settings
from torch_zerohess.search.metric_descent import BAD, FAR, RELATIVELY, MetricQuadratics
from torch_zerohess.search.metric_progress import MetricProgress
from torch_zerohess.search.state import Best, Evaluated
from torch_zerohess.surrogates.least_change import LeastNorm
from torch_zerohess.surrogates.loss_curvature import loss_curvature

_PATIENCE = 5
"""Refused steps in a row after which the method has failed."""
_HOLES = 3
"""Values in a row that are not finite, after which it has failed."""


@dataclass(frozen=True, eq=False, kw_only=True)
class OutputProgress(MetricProgress):
    """The progress of `OutputGaussNewton`; the metric stays the identity."""

    outputs: Tensor
    """Of the evaluations [P, m]."""
    bend: Tensor
    """What the curvature of the outputs adds to the Hessian [n, n], in units of `size`."""
    bent: bool = False
    """Whether the quadratic has it."""
    bending: float = 0.0
    """Its part of the loss that is predicted at the end of the step."""
    failed: bool = False
    """Whether the model does not hold here."""

    def remembered(self, evaluated: Evaluated, capacity: int) -> "OutputProgress":
        """Add evaluations whose values are finite."""
        new = evaluated.those(evaluated.finite)
        known = super().remembered(new, capacity)
        assert isinstance(known, OutputProgress)
        outputs = self.outputs
        if new.outputs is not None and len(new):
            outputs = torch.cat([outputs, new.outputs])[-capacity:] if len(outputs) else new.outputs
        lost = 0 if bool(evaluated.needed.finite.all()) else self.lost + 1
        return replace(
            known,
            outputs=outputs,
            shape=evaluated.shape,
            evaluations=self.evaluations + len(evaluated),
            lost=lost,
            failed=lost >= _HOLES,
        )


class OutputGaussNewton(MetricQuadratics):
    """A local search that keeps `capacity` evaluations. It ends when it has arrived or failed, and never starts again.

    It has the trust region of `MetricQuadratics`.
    """

    def __init__(self, settings: Settings, capacity: int) -> None:
        super().__init__(settings)
        self._capacity = capacity
        self._fitted = min(self._coefficients, capacity)

    def taking_over(self, known: DescentProgress, sigma: float) -> OutputProgress:
        """Return the progress at the best point of a round of another search, with a region of the radius sigma."""
        pool = known.pool
        assert pool.outputs is not None
        shared = {one: getattr(known, one) for one in ("best", "evaluations", "iterations", "shape")}
        begun = replace(self._begun(known.lowest), **shared)
        return replace(begun, points=pool.points, values=pool.values, outputs=pool.outputs, sigma=sigma)

    def plan(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        known, points = super().plan(known, generator)
        assert isinstance(known, OutputProgress)
        if known.phase == "trial" and len(points):
            step = points[0] - known.lowest.point
            known = replace(known, bending=0.5 * known.size * float(step @ known.bend @ step))
        return known, points

    def _begun(self, best: Best) -> OutputProgress:
        begun = super()._begun(best)
        same = {field.name: getattr(begun, field.name) for field in fields(MetricProgress)}
        return OutputProgress(**same, outputs=begun.points.new_zeros(0, 0), bend=begun.hessian)

    def _after_start(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        """Try a step at once: n + 1 outputs tell a Jacobian."""
        if len(known.values) <= self._n or bool((known.values == known.values[0]).all()):
            return self._on_plateau(known, generator)
        return self.plan(known, generator)

    def _judged(self, known: MetricProgress, ratio: float) -> tuple[MetricProgress, Tensor | None]:
        known, bad = super()._judged(known, ratio)
        assert isinstance(known, OutputProgress)
        missed = (ratio - 1.0) * known.promised  # how much less of the loss was left than was predicted
        other = missed + (-known.bending if known.bent else known.bending)
        known = replace(known, bent=known.bent != (abs(other) < abs(missed)))
        return replace(known, failed=ratio < BAD and known.refused >= _PATIENCE), bad

    def _modelled(self, known: MetricProgress) -> tuple[MetricProgress, int]:
        assert isinstance(known, OutputProgress)
        assert self.settings.loss is not None
        u, n = known.scaled, self._n
        distance = u.norm(dim=1)
        order = distance.argsort()
        nearest = order[1 : self._fitted]
        far = max(FAR, RELATIVELY * float(distance[order[min(n + 1, len(order) - 1)]]))
        nearest = nearest[(distance[nearest] <= far) | (torch.arange(len(nearest), device=u.device) < n)]
        center = known.outputs[order[0]]
        outputs = LeastNorm.through(u[nearest], known.outputs[nearest] - center)
        expanded = loss_curvature(self.settings.loss, center.view(known.shape))
        slope = expanded.slope.flatten()
        gradient = outputs.jacobian @ slope / known.sigma
        size = float(gradient.abs().max()) or 1.0
        unit = known.sigma**2 * size
        hessian = outputs.jacobian @ expanded.products(outputs.jacobian.view(n, *known.shape)).mT / unit
        bend = outputs.hessian(slope) / unit
        hessian = 0.5 * (hessian + hessian.mT) + (bend if known.bent else 0.0)
        return replace(known, size=size, gradient=gradient / size, hessian=hessian, bend=bend), len(nearest) + 1

    def _learned(self, known: MetricProgress, count: int) -> Tensor:
        return known.root

    def _on_plateau(self, known: MetricProgress, generator: torch.Generator) -> tuple[MetricProgress, Tensor]:
        assert isinstance(known, OutputProgress)
        return replace(known, failed=True), known.points[:0]

    def _arrived(
        self, known: MetricProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[MetricProgress, Tensor]:
        assert isinstance(known, OutputProgress)
        return replace(known, done=known.lost == 0, failed=known.lost > 0, message=reason), known.points[:0]
