"""The common part of Gauss-Newton searches: estimate the Jacobian of an output from samples, then try steps.

Steps of several lengths are evaluated together. If the best step lowers the loss, the search goes there, and the length
of the step is the next radius. Otherwise the radius shrinks. A subclass defines how the Jacobian is sampled and kept,
and how the model is solved for a step.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal, TypeVar

import torch
from torch import Tensor

from torch_zerohess.search.gauss_newton.kinked_steps import Steps
from torch_zerohess.search.protocol.method import Method
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import LOST, Best, Evaluated, Progress
from torch_zerohess.surrogates.quadratic import LocalModel

STEP_LENGTHS = (0.15, 0.3, 0.6, 1.0, 1.6, 2.5)
"""Of the steps that are tried, in units of the radius."""
SHRINKING = 0.4
"""Factor of the radius where no step lowers the loss."""
INSIDE = 0.5
"""Length of the step to the minimum of the loss of linear outputs, over the longest step, up to which the region
hardly shortened it."""
_INNER = 0.99
"""Length of a step, over the radius, below which the radius did not shorten it."""
_AROUND = 2.0
"""Distance from the center, over sigma sqrt(n), up to which the model at the center is one of the best point."""

Q = TypeVar("Q", bound="JacobianProgress")


@dataclass(frozen=True, eq=False, kw_only=True)
class JacobianProgress(Progress):
    """The output at the center, and the kind of points asked for next. A subclass adds the Jacobian."""

    phase: Literal["sample", "trial", "aside"] = "sample"
    """What is asked for next. sample: points around the center for the Jacobian; at first with the start. trial: the
    ends of steps. aside: points at which only parameters that no output was found to depend on have moved
    (`SparseMethod`)."""
    radius: float
    """Root mean square over the parameters."""
    output: Tensor
    """At the center [m], float64; empty before the first values."""
    loss: float = math.inf
    """At the center. The best point may be a sample with a lower loss."""

    @property
    def shaped_output(self) -> Tensor:
        """The output at the center [*out]."""
        return self.output.view(self.shape)

    @property
    def here(self) -> Best:
        """The center as a best point."""
        return Best(self.center, self.loss, self.sigma)

    def counted(self: Q, evaluated: Evaluated) -> Q:
        """Return the progress with a batch counted; it is done after too many batches without a finite value."""
        known = self.told(evaluated, lost=not bool(evaluated.finite.any()))
        return known if known.lost < LOST else known.ended_round(f"{LOST} batches in a row had no finite value", 0)

    def recorded(self: Q, evaluated: Evaluated) -> Q:
        """Return the progress with the lowest loss so far as the best one. Samples count as steps do."""
        return replace(self, best=self.best.or_lower(evaluated.sound, self.sigma))


class GaussNewton(Method[Q]):
    """A search that samples the Jacobian of an output and tries steps, in units of its sigma."""

    radius: float
    """Radius of the first region, in units of sigma."""

    @abstractmethod
    def begun(self) -> Q:
        """Return the progress before the first values."""

    @abstractmethod
    def samples(self, known: Q, generator: torch.Generator) -> tuple[Q, Tensor]:
        """Ask for samples [K, n] around the center."""

    @abstractmethod
    def renewed(self, known: Q, evaluated: Evaluated) -> Q:
        """Renew the Jacobian by samples with finite values, and say in `phase` what follows."""

    @abstractmethod
    def solved(self, known: Q, radii: Tensor) -> Steps:
        """Return a step [n] within each of the radii [k], in rising order."""

    @abstractmethod
    def gradient(self, known: Q) -> Tensor:
        """Return the gradient [n] of the loss at the center."""

    @abstractmethod
    def moved(self, known: Q, step: Tensor, change: Tensor) -> Q:
        """Return the progress after a step [n] that changed the output by [m]; `known` has the Jacobian before it."""

    @abstractmethod
    def distance(self, radius: float) -> float:
        """Return the sigma of the samples that go with a radius."""

    @abstractmethod
    def derivatives_at_center(self, known: Q) -> tuple[Tensor, Tensor] | None:
        """Return gradient [n] and Hessian [n, n] of the loss; None where they are not known, or too large."""

    def first(self, generator: torch.Generator) -> tuple[Q, Tensor]:
        """Ask for the start and samples around it."""
        known, points = self.samples(self.begun(), generator)
        return known, torch.cat([known.center[None], points])

    def next(self, known: Q, evaluated: Evaluated, generator: torch.Generator) -> tuple[Q, Tensor]:
        """Renew the Jacobian by samples, or take the best step; then ask for what follows."""
        known = known.counted(evaluated).recorded(evaluated)
        if not known.done and known.phase == "sample":
            known = self.sampled(known, evaluated)
        elif not known.done:
            known = self.taken(known, evaluated.sound)
        if known.done:
            return known, known.center[None][:0]
        return self.asked(known, generator)

    def asked(self, known: Q, generator: torch.Generator) -> tuple[Q, Tensor]:
        """Ask for what the phase says."""
        return (known, self.trials(known)) if known.phase == "trial" else self.samples(known, generator)

    def sampled(self, known: Q, evaluated: Evaluated) -> Q:
        """Renew the Jacobian by samples, the first of which is the start at the beginning."""
        assert evaluated.outputs is not None
        if not len(known.output):
            known = replace(known, output=evaluated.outputs[0].clone(), loss=float(evaluated.losses[0]))
            evaluated = evaluated.those(slice(1, None))
        return self.renewed(known, evaluated)

    def radii(self, known: Q) -> Tensor:
        """Return the lengths of the steps that are tried [k]."""
        return known.center.new_tensor(STEP_LENGTHS) * known.radius * math.sqrt(self.settings.n)

    def trials(self, known: Q) -> Tensor:
        """Return the ends of steps of all lengths [k, n]."""
        points = known.center + self.solved(known, self.radii(known)).steps
        return points.clamp(self.settings.lower, self.settings.upper)

    def taken(self, known: Q, evaluated: Evaluated) -> Q:
        """Go to the best of the steps with finite values if it lowers the loss."""
        known = replace(known, iterations=known.iterations + 1, phase="sample")
        k = int(evaluated.losses.argmin()) if len(evaluated) else -1
        if k >= 0 and float(evaluated.losses[k]) < known.loss:
            assert evaluated.outputs is not None
            point, output = evaluated.points[k].clone(), evaluated.outputs[k].clone()
            step, change = point - known.center, output - known.output
            loss, radius = float(evaluated.losses[k]), float(step.norm()) / math.sqrt(self.settings.n)
            known = self.moved(replace(known, center=point, loss=loss, radius=radius, output=output), step, change)
        else:
            known = self.rejected(known)
        if known.radius < self.settings.tolerance:
            known = self.arrived(known)
        return replace(known, sigma=self.distance(known.radius))

    def rejected(self, known: Q) -> Q:
        """Shrink the radius where no step lowers the loss."""
        return replace(known, radius=SHRINKING * known.radius)

    def arrived(self, known: Q) -> Q:
        """Start again with the first radius, or end."""
        known = known.ended_round(f"steps were below {self.settings.tolerance} of sigma", self.settings.restarts)
        return known if known.done else replace(known, radius=self.radius, phase="sample")

    def promise(self, known: Q) -> float:
        """Return what the step to the minimum of the model promises.

        It is infinite if the minimum is farther than the longest step, or if no step is next.
        """
        if known.phase != "trial":
            return math.inf
        radii = self.radii(known)
        found, longest = self.solved(known, radii), float(radii[-1])
        length = float(found.steps[-1].norm())
        if found.promised is not None:
            return found.promised if length <= INSIDE * longest else math.inf
        # At the minimum of a quadratic the decrease is half of what the gradient promises.
        return -0.5 * float(self.gradient(known) @ found.steps[-1]) if length < _INNER * longest else math.inf

    def width(self, known: Q) -> Tensor:
        """Return the radius for every parameter; infinity before a step, and where the minimum is farther away."""
        sound = known.iterations > 0 and self.promise(known) < math.inf
        return torch.full_like(known.center, known.radius if sound else math.inf)

    def model_at_best(self, known: Q) -> tuple[LocalModel, float] | None:
        """The model of the latest Jacobian, moved from the center to the best point, without standard errors.

        None farther from the center than samples are, and where the derivatives are not known.
        """
        away, sigma = known.best.point - known.center, known.sigma
        near = float(away.norm()) <= _AROUND * sigma * math.sqrt(self.settings.n)
        derivatives = self.derivatives_at_center(known) if near else None
        if derivatives is None:
            return None
        gradient, hessian = derivatives
        value = known.loss + float(away @ gradient) + 0.5 * float(away @ hessian @ away)
        gradient, unknown = gradient + hessian @ away, torch.full_like(known.center, math.inf)
        model = LocalModel(value, sigma * gradient, sigma**2 * hessian, None, unknown, unknown.clone())
        return model, sigma
