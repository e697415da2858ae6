"""The rule after a step on a model of the loss: move to its end, shrink sigma, or let sigma grow on a plateau."""

import math

from torch import Tensor

from torch_zerohess.search.descent.progress import WIDEST, DescentProgress
from torch_zerohess.search.protocol.replaced import replace

_SLACK = 2.0
"""Standard deviations of the noise within which a decrease does not count."""
_LONG, _GOOD, _GROWTH = 0.9, 0.5, 1.2
"""A step of this length, in units of the radius, that achieves this part of its promise widens sigma by this factor."""
_SHORT, _SHRINKING = 0.4, 0.75
"""A shorter step narrows sigma by this factor, and so does a step that is rejected."""
_TRUSTED = 0.7
"""Part of its promise that a step achieves when only the directions unknown to the model are worth samples."""
_PLATEAU, _PATIENCE = 1.3, 2
"""On a plateau sigma grows by this factor; on one that is wider than the widest sigma, this often."""


def after_loss(known: DescentProgress, point: Tensor, loss: float, noise: float) -> DescentProgress:
    """Return the progress after the loss at the end [n] of a step, with what to ask for next."""
    model = known.model
    assert model is not None
    slack = _SLACK * noise
    promised = model.decrease(known.step)
    ratio = (known.value - loss + slack) / (promised + slack) if promised + slack > 0.0 else -math.inf
    lowest = known.lowest.loss
    if min(loss, lowest) < known.value - slack:
        sigma = known.sigma
        if loss <= lowest and known.length > _LONG and ratio > _GOOD:
            sigma *= _GROWTH
        elif loss <= lowest and known.length < _SHORT:
            sigma *= _SHRINKING
        center, value = (point, loss) if loss <= lowest else (known.lowest.point, lowest)
        known = replace(known, center=center, value=value, sigma=sigma, patience=0)
        unknown = known.n - model.rank
        return known.sampling(unknown, paired=False) if ratio > _TRUSTED and unknown else known.trying()
    if model.significance < 0.0 and known.patience < _PATIENCE:
        patience = known.patience + (known.sigma >= WIDEST)
        wider = max(known.sigma, min(_PLATEAU * known.sigma, WIDEST))
        known = replace(known, sigma=wider, patience=patience)
    else:
        known = replace(known, sigma=_SHRINKING * known.sigma)
    return known.sampling(min(2**known.rounds, known.n))
