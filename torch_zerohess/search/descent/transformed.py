"""Descent on quadratics of a loss, and on quadratics of its square or logarithm where these predict it better.

The root of a mean square has a kink at its minimum, and its square is a quadratic. On a loss that grows steeply, as
a sum of exponentials, quadratics of its logarithm are valid in a larger region. At every step a quadratic is fitted to
the losses, and another one to the losses under their likeliest transform (`LossTransform`). A transform rises with the
loss, so it has the same minimum. Steps lead to the minimum of the quadratic that has predicted the latest losses
better.
"""

from functools import partial

import torch
from torch import Tensor

from torch_zerohess.search.descent.evidence import weighed
from torch_zerohess.search.descent.metric import MetricQuadratics, of_step
from torch_zerohess.search.descent.metric_progress import Fitted, MetricProgress, TransformedQuadratic
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated
from torch_zerohess.surrogates.least_change import least_change_of_transform

_ENOUGH = 2.0
"""Evidence from which steps follow the transformed loss."""
_FEWEST = 2
"""Values over n above which transforms are compared."""


class TransformedQuadratics(MetricQuadratics):
    """Descent on quadratics of a loss alone, or of its square or logarithm."""

    def next(
        self, known: MetricProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[MetricProgress, Tensor]:
        return super().next(self._compared_to_transformed(known, evaluated), evaluated, generator)

    def _compared_to_transformed(self, known: MetricProgress, evaluated: Evaluated) -> MetricProgress:
        """Compare the loss at the point that was needed with the predictions of both quadratics."""
        if known.transformed is None:
            return known
        plain = partial(super()._change, known)
        return replace(
            known, transformable=weighed(known.transformable, known, evaluated, plain, known.transformed.change)
        )

    def predicted(self, known: MetricProgress, x: Tensor) -> float:
        plain = super()._quadratic(known, self._fitted_to(known))  # it is fitted faster than one of transformed losses
        return self._expected(plain, x)

    def _quadratic(self, known: MetricProgress, fitted: Fitted) -> MetricProgress:
        known = super()._quadratic(known, fitted)
        u, values, size, shared = fitted
        if len(u) <= _FEWEST * self._n:
            return replace(known, transformed=None)
        before, transform, hessian, old_size = known.transformed, None, known.hessian, known.size
        if before is not None:
            hessian, old_size = before.hessian, before.size
            transform = replace(before.transform, shift=before.transform.shift * old_size / size)
        earlier = self._earlier(known, hessian, old_size / size, u, values)
        transform, gradient, hessian = least_change_of_transform(u, values, earlier, transform, shared)
        found = TransformedQuadratic(transform, size, *of_step(known, gradient, hessian))
        return replace(known, transformed=found)

    def _learned(self, known: MetricProgress, count: int) -> Tensor:
        return super()._learned(_with(known), count)

    def _minimum(self, known: MetricProgress, factor: float = 1.0) -> Tensor:
        return super()._minimum(_with(known), factor)

    def _change(self, known: MetricProgress, s: Tensor) -> float:
        return super()._change(known, s) if (used := _in_use(known)) is None else used.change(s)


def _in_use(known: MetricProgress) -> TransformedQuadratic | None:
    return known.transformed if known.transformable >= _ENOUGH else None


def _with(known: MetricProgress) -> MetricProgress:
    """Return the progress with the quadratic in use in place of the quadratic of the losses."""
    used = _in_use(known)
    return known if used is None else replace(known, gradient=used.gradient, hessian=used.hessian)
