"""Gauss-Newton for an output under a known loss, by interpolation in a trust region.

The Jacobian at the best point is the Jacobian of quadratics through the nearest evaluations, one per output
(`LeastNorm`). With the gradient and the Hessian of the loss it gives a quadratic of the loss, which is minimised within
the region. The Hessian has the curvature of the outputs where that predicted the last step better. At a kink of the
loss the quadratic is wrong. There the loss of the linear outputs itself is minimised (`kinked_minimum`). Points beyond
a bound stand for their mirror images: the bound is a kink, too. Where kinks meet, a slope may point to no decrease
although there is one, so the minimisation is repeated from points close by before the search arrives.

Where steps achieve what the model promises, this converges fast. Where they do not, the method fails, and says so.
Short steps that promise next to nothing and achieve nothing are an arrival: an adaptive solver of differential
equations rounds its outputs to 1e-8, say.

Source: Dennis, Gay and Welsch (1981), "An adaptive nonlinear least-squares algorithm" (NL2SOL), for the choice;
Cartis, Fiala, Marteau and Roberts (2019), "Improving the flexibility and robustness of model-based
derivative-free optimization solvers" (DFO-LS), for Gauss-Newton on interpolated outputs; Wild (2017), "Solving
derivative-free nonlinear least squares problems with POUNDERS", for quadratics of least norm; Larson, Menickelly and
Wild (2019), "Derivative-free optimization methods", for composite losses with kinks.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.linalg.nonsmooth import kinked_minimum, mirrored
from torch_zerohess.search.gauss_newton.kinked_steps import NOTHING, holds, shortened
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.random_points import normal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Evaluated, Progress
from torch_zerohess.search.region.method import BAD, LONG, NEAR, RegionDescent
from torch_zerohess.search.region.progress import RegionProgress
from torch_zerohess.surrogates.least_change import LeastNorm
from torch_zerohess.surrogates.loss_curvature import loss_curvature, value_then_slope
from torch_zerohess.surrogates.pool import Pool, latest
from torch_zerohess.surrogates.quadratic import coefficient_count

_PATIENCE = 5
"""Rejected steps in a row after which the method has failed."""
_STEEP = 10.0
"""Slope of the penalty beyond the region, over the slope of the loss."""
_ITERATIONS = 100
"""Of the minimisation without the quadratic."""
_LEAST_GAIN = 1e-3
"""Share of its decrease that ten iterations bring at least: the outputs are not known to be linear any better."""
_AGAIN, _ASIDE = ((1000, 1e-6), (1000, 1e-6)), 0.01
"""Iterations and least gains of further tries where it finds next to nothing and the slope is known, and the distance
of their starts from x, over the radius."""
_LEVEL = 1e-3
"""Distance from a bound, over the distance of the farthest evaluation near by, that does not determine the slope."""
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
    """Rejected steps in a row that were shorter than the tolerance and promised next to nothing."""
    kept: bool = False
    """Whether a step has kept its promise since the method began, or began again."""
    failed: bool = False
    """Whether the model does not hold here."""

    def remembered(self, evaluated: Evaluated, capacity: int) -> "OutputProgress":
        """Add evaluations whose values are finite."""
        new = evaluated.sound
        known, outputs = super().remembered(new, capacity), self.outputs
        known = known.taking(self.told(evaluated, lost=evaluated.lacking), "evaluations", "lost", "shape")
        if new.outputs is not None and len(new):
            outputs = torch.cat([outputs, new.outputs]) if len(outputs) else new.outputs
        return replace(
            known,
            outputs=outputs[latest(torch.cat([self.points, new.points]), known.lowest.point, capacity)],
            failed=known.lost >= _HOLES,
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
    _least_gain = NOTHING  # in smaller regions, roundings of the outputs promise more
    _singular = 1e-16  # the square of units of outputs that differ by 1e6, and a margin

    def __init__(self, settings: Settings, capacity: int, patience: int | None = None) -> None:
        super().__init__(settings, min(coefficient_count(settings.n), capacity), capacity)
        self._patience = _PATIENCE if patience is None else patience
        self._linear: tuple[Tensor, Tensor] | None = None  # output [m] and Jacobian [n, m] of the last quadratic

    def taking_over(self, known: Progress, pool: Pool, lowest: Best, sigma: float) -> OutputProgress:
        """Return the progress at the best point of a round of another search, with a region of the radius sigma.

        Args:
            known: what the other search knows.
            pool: its evaluations.
            lowest: its best point of the round.
            sigma: the radius.
        """
        assert pool.outputs is not None
        begun = self._begun(lowest).taking(known, "best", "evaluations", "iterations", "shape")
        return begun.holding(pool.points, pool.values, outputs=pool.outputs, sigma=sigma)

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
        """Try a step at once: n + 1 outputs determine a Jacobian."""
        if len(known.values) <= self._n or bool((known.values == known.values[0]).all()):
            return self._on_plateau(known, generator)
        return self.plan(known, generator)

    def _judged(self, known: OutputProgress, ratio: float) -> tuple[OutputProgress, Tensor | None]:
        known, bad = super()._judged(known, ratio)
        error = (ratio - 1.0) * known.promised  # predicted loss minus the loss at the end of the step
        other = error + (-known.curved_part if known.curved else known.curved_part)
        known = replace(known, curved=known.curved != (abs(other) < abs(error)))
        kept = known.kept or ratio >= BAD
        nothing = known.promised <= NOTHING * abs(known.lowest.loss)
        is_short = known.length < LONG and known.length * known.sigma < self.settings.tolerance and nothing
        short = known.short + is_short if known.rejected else 0
        known = replace(known, kept=kept, short=short)
        if known.rejected < (_PATIENCE if kept else self._patience):
            return known, bad
        if 2 * short <= known.rejected:
            return replace(known, failed=True), bad
        return replace(known, done=True, message="short steps promise and achieve nothing"), bad

    def _unseen(self, known: OutputProgress) -> Tensor | None:
        """Return the axis off a bound on which the best point and all evaluations near it lie.

        Least norm makes the slope along it zero, so that the best point would pass for a minimum.
        """
        x, settings = known.lowest.point, self.settings
        near = known.points[known.scaled.norm(dim=1) <= NEAR] - x
        level = near.abs().amax(0) <= _LEVEL * near.norm(dim=1).max()
        unseen = level & ((x == settings.lower) | (x == settings.upper))
        if not bool(unseen.any()):
            return None
        return torch.nn.functional.one_hot(unseen.nonzero()[0, 0], self._n).to(x)

    def _is_known(self, known: OutputProgress) -> bool:
        """Whether evaluations near the best point determine its slope in every direction."""
        near = int((known.scaled.norm(dim=1) <= NEAR).sum())
        return known.confirmed or (near > self._n and self._unseen(known) is None)

    def _modelled(self, known: OutputProgress) -> tuple[OutputProgress, int]:
        nearest = self._nearest(known, self._n + 1)
        center, others = known.outputs[nearest[0]], nearest[1:]
        outputs = LeastNorm.through(known.scaled[others], known.outputs[others] - center)
        expanded = loss_curvature(self.settings.white_box, center.view(known.shape))
        slope = expanded.slope.flatten()
        gradient = outputs.jacobian @ slope / known.sigma
        size = float(gradient.abs().max()) or 1.0
        unit = known.sigma**2 * size
        self._linear = center, outputs.jacobian / known.sigma
        hessian = outputs.jacobian @ expanded.products(outputs.jacobian.view(self._n, *known.shape)).mT / unit
        curvature = outputs.hessian(slope) / unit
        hessian = 0.5 * (hessian + hessian.mT) + (curvature if known.curved else 0.0)
        return replace(known, size=size, gradient=gradient / size, hessian=hessian, curvature=curvature), len(nearest)

    def _step(self, known: OutputProgress) -> tuple[Tensor, float]:
        """Return the step to the minimum of the quadratic. If that is wrong, minimise the loss of the linear outputs.

        The quadratic is wrong at a kink of the loss, and where the curvature of the loss changes within the region.
        """
        s, promised = super()._step(known)
        curvature = known.size * known.curvature if known.curved else torch.zeros_like(known.curvature)
        before, _ = self._of_linear(known, curvature, torch.zeros_like(s))
        after, _ = self._of_linear(known, curvature, s)
        if holds(before, after, promised):
            return s, promised
        x, settings, radius = known.lowest.point, self.settings, known.sigma
        lower, upper = ((one - x).clamp(-2.0 * radius, 2.0 * radius) for one in (settings.lower, settings.upper))
        steep = _STEEP * known.size * max(float(known.gradient.norm()), math.ulp(0.0))

        def penalised(s: Tensor) -> tuple[float, Callable[[], Tensor]]:
            inside, signs = mirrored(s, lower, upper)
            value, slope = self._of_linear(known, curvature, inside)
            length = float(inside.norm())
            if length <= radius:
                return value, lambda: signs * slope()
            return value + steep * (length - radius), lambda: signs * (slope() + steep * inside / length)

        def lowest(start: Tensor, iterations: int, least_gain: float) -> Tensor:
            t, _ = mirrored(kinked_minimum(penalised, start, iterations, radius, least_gain), lower, upper)
            return shortened(t, radius)

        zero, generator = torch.zeros_like(s), torch.Generator().manual_seed(0)
        t = lowest(s if after < before else zero, _ITERATIONS, _LEAST_GAIN)
        # Where kinks meet, a slope may point to no decrease although there is one.
        again = _AGAIN if self._is_known(known) else ((_ITERATIONS, _LEAST_GAIN),)
        for iterations, least_gain in again:
            if before - self._of_linear(known, curvature, t)[0] > NOTHING * abs(before):
                break
            beside = _ASIDE * radius * torch.nn.functional.normalize(normal(generator, s, self._n), dim=0)
            end = lowest(beside, iterations, least_gain)
            t = min(t, end, key=lambda one: self._of_linear(known, curvature, one)[0])
        return t, before - self._of_linear(known, curvature, t)[0]

    def _of_linear(self, known: OutputProgress, curvature: Tensor, s: Tensor) -> tuple[float, Callable[[], Tensor]]:
        """Return the loss of the linear outputs at a step [n], with the curvature of the outputs; then its slope."""
        assert self._linear is not None
        output, jacobian = self._linear
        loss, slope = value_then_slope(self.settings.white_box, (output + s @ jacobian).view(known.shape))
        bent = curvature @ s
        return loss + 0.5 * float(s @ bent), lambda: jacobian @ slope().flatten() + bent

    def _on_plateau(self, known: OutputProgress, generator: torch.Generator) -> tuple[OutputProgress, Tensor]:
        return replace(known, failed=True), known.points[:0]

    def _arrived(
        self, known: OutputProgress, reason: str, generator: torch.Generator, *, last: bool = False
    ) -> tuple[OutputProgress, Tensor]:
        return replace(known, done=known.lost == 0, failed=known.lost > 0, message=reason), known.points[:0]
