"""Descent on quadratics, and on the larger of two quadratics beside a kink.

No quadratic predicts a loss on both sides of a kink, as of c + w max(0, d) or max(c, d). So after a rejected step the
larger of two quadratics is fitted, too (`fit_two_sides`). Where it has predicted the latest losses better, the steps
lead to its minimum.

The metric of the region is learned from the Hessian of the quadratics mixed as their gradients balance: the Hessian
along the kink.
"""

from functools import partial

import torch
from torch import Tensor

from torch_zerohess.linalg.larger_of_two import least_of_larger, share_of_shortest
from torch_zerohess.linalg.metric import learned, region_step
from torch_zerohess.search.descent.evidence import weighed
from torch_zerohess.search.descent.metric import CURVED
from torch_zerohess.search.descent.metric_progress import MetricProgress, TwoSides
from torch_zerohess.search.descent.transformed import TransformedQuadratics
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated
from torch_zerohess.surrogates.two_sides import fit_two_sides

_MOST = 10
"""Parameters up to which two quadratics are fitted."""
_ENOUGH = 2.0
"""Evidence from which steps follow two quadratics."""
_FEWEST = 2
"""Evaluations, beyond the coefficients of one quadratic, that two are fitted to at least."""
_FAR, _RELATIVELY = 8.0, 2.0
"""Evaluations farther than this, and than this times the distance of the n + 3 nearest ones, are left out."""
_SHARP = 3.0
"""The gradient changes across a kink by at least so many times its change along the kink within the region. Two
quadratics of a smooth loss differ by less."""


class TwoSidedQuadratics(TransformedQuadratics):
    """Descent on quadratics of a loss alone, and on the larger of two beside a kink."""

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        return super().next(self._weighed(known, evaluated), evaluated, generator)

    def _weighed(self, known: MetricProgress, evaluated: Evaluated) -> MetricProgress:
        """Compare the loss at the point that was needed with what one quadratic and two have predicted."""
        if known.sides is None:
            return known
        one = partial(super()._change, known)
        return replace(known, evidence=weighed(known.evidence, known, evaluated, one, known.sides.change))

    def _modelled(self, known: MetricProgress) -> tuple[MetricProgress, int]:
        known, count = super()._modelled(replace(known, sides=None))
        wanted = known.rejected > 0 or known.evidence > 0.0
        return (replace(known, sides=self._sides(known)) if wanted and self._n <= _MOST else known), count

    def _sides(self, known: MetricProgress) -> TwoSides | None:
        """Fit two quadratics to the nearest evaluations.

        None if they do not determine two quadratics, or if there is no kink between these.
        """
        n, u = self._n, known.scaled
        distance = u.norm(dim=1)
        order = distance.argsort()
        order = order[~known.holes[order]][: 2 * (self._coefficients + n)]
        if len(order) < self._coefficients + _FEWEST:
            return None
        order = order[distance[order] <= max(_FAR, _RELATIVELY * float(distance[order[n + 2]]))]
        found = fit_two_sides(u[order], known.values[order] - known.lowest.loss)
        if found is None:
            return None
        in_u = TwoSides(found, share_of_shortest(found[0, 1:, 0], found[1, 1:, 0]))
        if float(in_u.jump.norm()) < _SHARP * float(in_u.mixed[1:, 1:].norm()):
            return None
        to_u = torch.block_diag(torch.ones_like(known.root[:1, :1]), torch.linalg.inv(known.sigma * known.root))
        return replace(in_u, matrices=to_u.mT @ found @ to_u)

    def _learned(self, known: MetricProgress, count: int) -> Tensor:
        if (sides := _in_use(known)) is None:
            return super()._learned(known, count)
        floor = CURVED * float(sides.jump.norm()) / known.sigma
        return learned(known.root, sides.mixed[1:, 1:], self._rate(count), floor)

    def _minimum(self, known: MetricProgress, factor: float = 1.0) -> Tensor:
        if (sides := _in_use(known)) is None:
            return super()._minimum(known, factor)
        x, settings = known.lowest.point, self.settings
        region = factor * known.sigma * known.root, settings.lower - x, settings.upper - x, self._singular, known.border
        return least_of_larger(sides.matrices, lambda gradient, hessian: region_step(gradient, hessian, *region))

    def _change(self, known: MetricProgress, s: Tensor) -> float:
        return super()._change(known, s) if (sides := _in_use(known)) is None else sides.change(s)


def _in_use(known: MetricProgress) -> TwoSides | None:
    return known.sides if known.evidence >= _ENOUGH else None
