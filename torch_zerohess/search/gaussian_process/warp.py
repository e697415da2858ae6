"""Scales of losses on which a process predicts them: logarithms, squares, or the losses as they are.

A stationary process varies as fast everywhere. Losses that span many decades do so only on a log scale. The root of a
mean square has a kink at its minimum, and its square has none. The evidence of the process chooses the scale, as it
chooses the kernel: the likelihood of transformed losses y times the slopes dy/dv is a likelihood of the losses v
(Snelson, Rasmussen and Ghahramani 2004).

Losses without noise have the transforms of `LossTransform`. Noisy losses v >= 0 above the lowest one are warped, to
y = u asinh(v / u): equal to v up to about u, and a logarithm beyond. The slope is 1 where losses are low, so noise
keeps its standard deviation there. Noise of high losses becomes smaller than the process takes it to be.

A process of warped losses knows only the flanks of other basins, and expects nothing lower there. So in noise one step
in `LOOK` is by a process of the losses as they are. This step does not move the best point: its process does not
resolve low losses.
"""

import math

import torch
from torch import Tensor

from torch_zerohess.surrogates.gaussian_process import (
    HIGH_NOISES,
    NOISES,
    Spectra,
    spectral_evidence,
    transformed_evidence,
)
from torch_zerohess.surrogates.loss_transform import transformed, warped

LOOK = 4
"""One step in so many looks for other basins."""
_PLAIN = 3.0
"""Log prior of losses as they are, over that of a transform; times 2."""
_UNITS = (300.0, 30.0)
"""Units u of a warp, over the noise, to choose from. No warp is the third choice."""


def likeliest(spectra: Spectra, losses: Tensor, deviation: float) -> Tensor:
    """Return losses [P] on the scale on which a process has the highest evidence.

    Args:
        spectra: of the process at the points [P, n].
        losses: [P], the lowest one 0, the highest one at most 1.
        deviation: standard deviation of repeated losses at one point; 0 if they are the same.
    """
    if deviation:
        return _warped(spectra, losses, deviation)
    P, n = spectra.points.shape
    return _transformed(spectra, losses) if n + 1 < P else losses


def _warped(spectra: Spectra, losses: Tensor, deviation: float) -> Tensor:
    """Return noisy losses, warped or as they are."""
    likely, highest = losses, -math.inf
    for unit in (math.inf, *(one * deviation for one in _UNITS)):
        values, slopes = warped(losses, unit)
        change = (values - values.mean())[:, None]
        evidence, _ = spectral_evidence(spectra, change, NOISES + HIGH_NOISES, deviation)
        # Twice the log likelihood. It is not finite where a slope is 0 by rounding, and then the unit is not chosen.
        total = float(evidence.max()) + 2.0 * float(slopes.log().sum())
        if total > highest:
            likely, highest = values, total
    return likely


def _transformed(spectra: Spectra, losses: Tensor) -> Tensor:
    """Return losses without noise, under a transform or as they are."""
    _, columns, slopes = transformed(losses)
    columns, slopes = torch.cat([columns, losses[:, None]], 1), torch.cat([slopes, slopes.new_zeros(1)])
    evidence = transformed_evidence(spectra, columns) + 2.0 * len(losses) * slopes
    evidence[-1] += _PLAIN
    return columns[:, int(evidence.argmax())]
