"""The rule after a step on a model of the output: follow the minimum of the model, and sample where it erred.

The search moves with the minimum of loss(E f), the loss of the smoothed output, also where the loss itself rises for a
while, and sigma goes to zero. The worse the output of a step was predicted, the more samples the next step gets.
"""

import math

from torch import Tensor

from torch_zerohess.search.descent.progress import WIDEST, DescentProgress
from torch_zerohess.search.protocol.replaced import replace

_FAITHFUL = 0.25
"""Misfit of a predicted output up to which the model needs no new evaluations."""
_TOLERABLE = 5.0
"""Misfit up to which a step that lowers the loss is itself what the model needs to know."""
_GAIN = 0.02
"""Part of the loss that a step with a misfit up to `_TOLERABLE` must take away."""
_BAD_MODEL = 2.0
"""Misfit beyond which the next step needs more samples than the last one."""
_NARROW, _BY_LENGTH, _WIDER = 0.85, 0.3, 1.05
"""Factor for sigma after a step of no length, its growth with the length, and the largest one."""
_LONG, _WIDENING = 0.9, 1.5
"""A faithful step of this length widens sigma by this factor, up to the widest one."""
_FEWER = 8
"""Parameters per pair of samples where the model was not far off."""
_RETRIES = 2
"""Shorter steps tried in a row before samples are drawn."""
_SHORTER, _RETRY = 0.4, 0.9
"""Length of a shorter step in units of the step before, and its factor for sigma."""
_STALLED = 8
"""Latest steps, in which the smoothed loss must have fallen."""
_FALL, _FAST_SHRINK = 0.95, 0.8
"""Compare the lowest smoothed loss of the latest steps with the lowest one of the steps before. Where it is above the
first number times that one, sigma is also multiplied by the second number."""
_FLAT = 0.03
"""Relative change of the loss below which a step has stayed on a plateau."""
_PLATEAU, _PATIENCE = 1.3, 4
"""Factor for sigma on a plateau, and how often sigma grows there."""
_BETTER = 0.9
"""If the best point of the round has less than this part of the loss, the search returns to it from a plateau."""


def after_output(known: DescentProgress, point: Tensor, loss: float, output: Tensor) -> DescentProgress:
    """Return the progress after the output [m] and its loss at the end [n] of a step, with what to ask for next."""
    model, length, before = known.model, known.length, known.value
    assert model is not None
    misfit, gain = model.misfit(known.step, output), before - loss
    if known.faithful and gain <= 0.0 and known.retries < _RETRIES:
        # The model was good so far: a shorter step, from a model that knows this point, is cheaper than samples.
        retries, sigma = known.retries + 1, _RETRY * known.sigma
        return replace(known, retries=retries, reach=_SHORTER * length, sigma=sigma).trying()
    known = replace(known, center=point, value=loss, retries=0, reach=1.0)
    if misfit < _TOLERABLE and gain > _GAIN * abs(before):
        sigma = known.sigma * _narrowing(length) if misfit > _FAITHFUL else known.sigma
        if misfit < _FAITHFUL and length > _LONG:
            sigma = max(sigma, min(_WIDENING * sigma, WIDEST))
        known = replace(known, faithful=True, misled=0, sigma=sigma)
        unknown = known.n - model.rank
        return known.sampling(unknown, paired=False) if misfit < _FAITHFUL and unknown else known.trying()
    misled = 0 if misfit < _FAITHFUL else known.misled + (misfit > _BAD_MODEL)
    known = replace(known, faithful=misfit < _FAITHFUL and gain > 0.0, misled=misled)
    known = _followed(known, model.value)
    narrow = _narrowing(length)
    if min(known.recent) > _FALL * known.earlier:
        narrow *= _FAST_SHRINK
    if abs(gain) < _FLAT * abs(before) and misfit > _FAITHFUL and known.patience < _PATIENCE:
        known = replace(known, patience=known.patience + 1)
        if known.lowest.loss < _BETTER * before:
            known = replace(known, center=known.lowest.point, value=known.lowest.loss)
        else:
            narrow = max(narrow, min(_PLATEAU, WIDEST / known.sigma))
    known = replace(known, sigma=narrow * known.sigma)
    some, most = 2 * math.ceil(known.n / _FEWER), 2 * math.ceil(known.n / 2)
    return known.sampling(min(2**known.misled, most) if misfit > _BAD_MODEL else some)


def _followed(known: DescentProgress, smoothed: float) -> DescentProgress:
    """Note a smoothed loss."""
    every, late = (*known.recent, smoothed), -_STALLED
    return replace(known, recent=every[late:], earlier=min([known.earlier, *every[:late]]))


def _narrowing(length: float) -> float:
    """Factor for sigma after a step of a length in units of the radius: short steps have found the minimum."""
    return min(_NARROW + _BY_LENGTH * length, _WIDER)
