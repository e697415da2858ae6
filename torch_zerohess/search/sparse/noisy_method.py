"""Gauss-Newton on a sparse Jacobian in noise: all evaluations nearby determine it and the output at the center.

It begins as `SparseMethod` does, and takes each output for true. Samples come with the center again: two outputs at one
point measure the noise. Where the best step changes the loss by no more than noise may, `Averaging` begins. From then
on no single output is trusted, and the search neither hops nor ends by itself: with further evaluations it becomes more
exact.
"""

import torch
from torch import Tensor

from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Evaluated
from torch_zerohess.search.sparse.averaging import Averaging
from torch_zerohess.search.sparse.method import SparseMethod
from torch_zerohess.search.sparse.progress import SparseProgress
from torch_zerohess.search.sparse.settings import SparseSearchSettings

_LUCK = 4.0
"""Standard deviations of a loss up to which the change by the best step may be noise."""
_AGREED = 3
"""Rounds in a row that have arrived at the best point, after which averaging begins."""
_KEPT, _HELD = 1024, 1 << 25
"""Evaluations that are kept, and numbers of their points and outputs, at most."""


def sparse_method(settings: Settings, own: SparseSearchSettings) -> SparseMethod:
    """Return the search by a sparse Jacobian: in noise, or without."""
    return NoisySparseMethod(settings, own) if settings.noise else SparseMethod(settings, own)


class NoisySparseMethod(SparseMethod):
    """The search of `LocalGaussNewton` in noise, in units of its sigma."""

    averages = True

    def __init__(self, settings: Settings, own: SparseSearchSettings) -> None:
        super().__init__(settings, own)
        self.averaging = Averaging(settings, own)

    def has_averaged(self, known: SparseProgress) -> bool:
        return known.averaging

    def samples(self, known: SparseProgress, generator: torch.Generator) -> tuple[SparseProgress, Tensor]:
        """Draw samples from N(center, sigma^2), mirrored into the bounds, after the center: twice when it averages."""
        if known.averaging:
            return known, self.averaging.points(known, generator)
        after, points = super().samples(known, generator)
        return after, torch.cat([known.center[None], points]) if len(known.output) else points

    def next(
        self, known: SparseProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[SparseProgress, Tensor]:
        """Go on as without noise; or fit, judge the last step, take the next one, and ask for center and samples."""
        if not known.averaging:
            return super().next(known, evaluated, generator)
        known = known.counted(evaluated)
        if known.done:
            return known, known.center[None][:0]
        return self.asked(self.sampled(known, evaluated), generator)

    def asked(self, known: SparseProgress, generator: torch.Generator) -> tuple[SparseProgress, Tensor]:
        return self.samples(known, generator) if known.averaging else super().asked(known, generator)

    def sampled(self, known: SparseProgress, evaluated: Evaluated) -> SparseProgress:
        """Keep the evaluations; the first ones, at the center, measure the noise of the outputs."""
        known, outputs, finite = self._keeping(known, evaluated), evaluated.outputs, evaluated.finite
        assert outputs is not None
        if known.averaging:
            if bool(finite[:2].all()) and len(outputs) > 1:
                known = known.telling_noise(outputs[0], outputs[1])
            return self.averaging.averaged(known, evaluated.those(finite), outputs[:2][finite[:2]])
        if not len(known.output):
            return super().sampled(known, evaluated)
        if bool(finite[0]):
            known = known.telling_noise(outputs[0], known.output)
        return super().sampled(known, evaluated.those(slice(1, None)))

    def taken(self, known: SparseProgress, evaluated: Evaluated) -> SparseProgress:
        """Take the best step; or begin to average where noise hides what it achieves."""
        known = self._keeping(known, evaluated)
        hidden = False
        if len(evaluated) and not known.failed:
            change = abs(float(evaluated.losses.min()) - known.loss)
            hidden = change < _LUCK * self.averaging.error(known, known.variance)
        after = self._begin(known) if hidden else super().taken(known, evaluated)
        return self.averaging.begun(replace(after, sigma=known.sigma)) if after.averaging else after

    def _hopping(self, known: SparseProgress) -> SparseProgress:
        return self._begin(known) if known.agreed >= _AGREED else super()._hopping(known)

    def promise(self, known: SparseProgress) -> float:
        return self.averaging.promise(known) if known.averaging else super().promise(known)

    def width(self, known: SparseProgress) -> Tensor:
        return self.averaging.width(known) if known.averaging else super().width(known)

    def _keeping(self, known: SparseProgress, evaluated: Evaluated) -> SparseProgress:
        """Keep the evaluations with finite values, as far as there is room."""
        sound = evaluated.sound
        assert sound.outputs is not None
        held = max(sound.points.shape[1] + sound.outputs.shape[1], 1)
        most = max(min(_KEPT, _HELD // held), 2 * self.own.samples)
        points, outputs = sound.points[:most], sound.outputs[:most]
        if len(known.points):
            points, outputs = torch.cat([known.points, points]), torch.cat([known.outputs, outputs])
        return replace(known, points=points[-most:], outputs=outputs[-most:])

    def _begin(self, known: SparseProgress) -> SparseProgress:
        return replace(known, averaging=True, best=known.here, home=None, phase="sample", samples=self.own.samples)
