"""The progress of a descent in a learned metric, between two evaluations."""

import math
from dataclasses import dataclass
from typing import NamedTuple

from torch import Tensor

from torch_zerohess.linalg.larger_of_two import two_values
from torch_zerohess.search.descent.axis_search import AxisLines
from torch_zerohess.search.descent.progress import DescentProgress
from torch_zerohess.search.protocol.state import Best
from torch_zerohess.search.region.progress import RegionProgress
from torch_zerohess.surrogates.least_change import Interpolation
from torch_zerohess.surrogates.loss_transform import LossTransform


class Fitted(NamedTuple):
    """What quadratics are fitted to."""

    u: Tensor
    """The nearest points [P, n]."""
    values: Tensor
    """Their losses [P] above the lowest one, over their size."""
    size: float
    """Of the losses."""
    shared: Interpolation
    """What depends on the points alone."""


@dataclass(frozen=True, eq=False)
class TwoSides:
    """Two quadratics beside a kink."""

    matrices: Tensor
    """[2, n + 1, n + 1]; the quadratics of a step s from the best point are (1, s) M (1, s) / 2, above its loss."""
    share: float
    """At s = 0 the gradients nearly balance with the shares 1 - w of the first one and w of the second one."""

    @property
    def mixed(self) -> Tensor:
        """Matrix [n + 1, n + 1] of the quadratic with these shares."""
        return (1.0 - self.share) * self.matrices[0] + self.share * self.matrices[1]

    def change(self, s: Tensor) -> float:
        """Return the change of the loss by a step [n]."""
        return float(two_values(self.matrices, s[None]).amax())

    @property
    def jump(self) -> Tensor:
        """Change of the gradient [n] across the kink, at s = 0."""
        return self.matrices[1, 1:, 0] - self.matrices[0, 1:, 0]


@dataclass(frozen=True, eq=False)
class TransformedQuadratic:
    """A quadratic of transformed losses (`LossTransform`), of steps s from the best point."""

    transform: LossTransform
    """Its shift is in units of `size`."""
    size: float
    """The losses over this number are transformed."""
    gradient: Tensor
    """[n]"""
    hessian: Tensor
    """[n, n]"""

    def change(self, s: Tensor) -> float:
        """Return the change of the loss by a step [n]."""
        return self.size * self.transform.inverse(float(self.gradient @ s + 0.5 * (s @ self.hessian @ s)))


@dataclass(frozen=True, eq=False, kw_only=True)
class MetricProgress(RegionProgress):
    """The progress of a descent in a learned metric."""

    wide: DescentProgress | None = None
    """Isotropic descent on the smoothed loss, which takes over on a plateau."""
    bottom: Best | None = None
    """The lowest point at which a round has arrived; None if there is none, or if no quadratic is kept."""
    slope: Tensor | None = None
    """Gradient there [n]."""
    bend: Tensor | None = None
    """Hessian there [n, n]."""
    above: float = math.inf
    """Loss of this round above `bottom`, where it was last predicted."""
    times: int = 0
    """Predictions in a row that were right."""
    transformed: TransformedQuadratic | None = None
    """The last quadratic of transformed losses, see `TransformedQuadratics`."""
    transformable: float = 0.0
    """How much better it has predicted the latest losses than the quadratic of the losses themselves."""
    sides: TwoSides | None = None
    """Two quadratics beside a kink, see `TwoSidedQuadratics`; None where one is enough."""
    evidence: float = 0.0
    """How much better two quadratics have predicted the latest losses than one."""
    slopes: Tensor | None = None
    """Gradients [m, n] at random points around a kink, see `KinkCheck`; None where there is none."""
    reason: str = ""
    """Why the round has come to it."""
    lines: AxisLines | None = None
    """What is known along the axes, see `AxisSearch`; None before rounds are compared with it."""
