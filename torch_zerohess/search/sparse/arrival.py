"""Where the search by a sparse Jacobian has arrived, and how it hops: the part of `SparseMethod` that ends rounds.

Steps may become short although the search has not arrived: where bounds and kinks meet, or where the Jacobian lacks
entries. So, before it arrives, a thorough search minimises the loss of linear outputs within the first radius. If the
Jacobian is not exact, it is sampled at the center first. If the minimum is lower than the center, the search goes on
towards the minimum. If steps towards the minimum do not lower the loss, the round ends without an arrival.
"""

import math

import torch
from torch import Tensor

from torch_zerohess.search.gauss_newton.by_samples import INSIDE, SHRINKING, STEP_LENGTHS, GaussNewton
from torch_zerohess.search.gauss_newton.kinked_steps import LITTLE, Steps
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.sparse.progress import SparseProgress
from torch_zerohess.search.sparse.settings import SparseSearchSettings
from torch_zerohess.search.sparse.steps import sparse_steps, thorough_step

MOST = 2
"""Samples of a batch, over the first number of samples, at most."""
_SAME = 0.01
"""A hop confirms a minimum if its end is above the minimum by less than this share of the loss that the hop added."""
_SHARED = (
    *("best", "evaluations", "iterations", "arrivals", "lost", "evidence", "grid"),
    *("points", "outputs", "variance", "pairs"),
)
"""What a search that returns from a hop keeps."""


class SparseArrivals(GaussNewton[SparseProgress]):
    """The steps of `SparseMethod`, and what follows where they are short."""

    def __init__(self, settings: Settings, own: SparseSearchSettings) -> None:
        super().__init__(settings)
        self.own, self.radius = own, own.radius
        self._last: tuple[SparseProgress, Tensor, Steps] | None = None  # progress, lengths and steps

    def solved(self, known: SparseProgress, radii: Tensor) -> Steps:
        """Solve the model, see `sparse_steps`."""
        last, settings = self._last, self.settings
        if last is not None and last[0] is known and torch.equal(last[1], radii):
            return last[2]
        assert known.jacobian is not None
        box = settings.lower - known.center, settings.upper - known.center
        found = sparse_steps(settings.white_box, known.shaped_output, known.jacobian, radii, *box)
        if known.thorough:
            found = self._thorough(known, float(radii[-1]), found.steps[-1])
            found = replace(found, steps=radii[:, None] / radii[-1] * found.steps)
        self._last = known, radii, found
        return found

    def _thorough(self, known: SparseProgress, longest: float, start: Tensor) -> Steps:
        """Return the step of a thorough search, from the end of another step [n]."""
        assert known.jacobian is not None
        settings, output = self.settings, known.shaped_output
        lower, upper = settings.lower - known.center, settings.upper - known.center
        start = start.clamp(lower, upper)
        return thorough_step(settings.white_box, output, known.jacobian, longest, lower, upper, start)

    def at_kink(self, known: SparseProgress) -> SparseProgress:
        """Sample as near as samples get, then arrive. Where the Jacobian does not predict, shrink the radius."""
        own, radius, near = self.own, SHRINKING * known.radius, known.sigma <= self.own.least_sigma
        if known.predicts and not near:
            radius = min(radius, own.least_sigma / own.share)
        known = replace(known, radius=radius, phase="sample")
        if (known.predicts and near) or radius < self.settings.tolerance:
            known = self.arrived(known)
        return replace(known, sigma=self.distance(known.radius))

    def arrived(self, known: SparseProgress) -> SparseProgress:
        """End, hop, or begin again with the first radius where the Jacobian does not predict."""
        if known.failed:
            return self._returned(known)
        if not known.predicts:
            return super().arrived(known)
        if known.misses and not (known.fresh or self.settings.noise):
            return replace(known, phase="sample", samples=max(known.samples, self._enough))
        found = None if self.settings.noise else self._lower_end(known)
        if found is not None and known.loss < known.doubted - LITTLE * abs(known.loss):
            return self._doubting(known, found)
        if known.some_stay and not (known.moved or self.settings.noise):
            return replace(known, phase="aside")
        if found is None:
            known = known.arriving(known.here).agreeing(known.here, self.settings.tolerance)
        known = super().arrived(replace(known, thorough=False))
        return known if known.done else self._hopping(replace(known, finished=True))

    @property
    def _enough(self) -> int:
        """Number of samples that determine a dense Jacobian and test its prediction; 0 if too many."""
        enough = math.ceil(1.25 * self.settings.n) + 4
        return enough if enough <= MOST * self.own.samples else 0

    def _lower_end(self, known: SparseProgress) -> Tensor | None:
        """Return a step [n] that lowers the loss of linear outputs by more than `LITTLE`, unless it is short."""
        root = math.sqrt(self.settings.n)
        found = self._thorough(known, self.radius * root, torch.zeros_like(known.center))
        assert found.promised is not None
        little = found.promised <= LITTLE * abs(known.loss)
        short = float(found.steps.norm()) <= INSIDE * STEP_LENGTHS[-1] * self.settings.tolerance * root
        return None if little or short else found.steps[0]

    def _doubting(self, known: SparseProgress, step: Tensor) -> SparseProgress:
        """Go on along a step [n], and take the steps of a thorough search from here on."""
        radius = float(step.norm()) / math.sqrt(self.settings.n)
        return replace(known, thorough=True, doubted=known.loss, radius=radius, phase="trial", slow=0)

    def rejected(self, known: SparseProgress) -> SparseProgress:
        """Shrink the radius; where a thorough search has misled, sample near first, and then try shorter steps."""
        if not known.thorough:
            return super().rejected(known)
        if known.fresh:
            return replace(super().rejected(known), phase="trial")
        return replace(known, radius=min(SHRINKING * known.radius, self.own.least_sigma / self.own.share))

    def stalled(self, known: SparseProgress) -> SparseProgress:
        """Hop, or return from a hop; go on where neither may help."""
        if known.failed:
            return self._returned(known)
        if known.patient or known.rounds >= self.settings.restarts or not known.predicts:
            return known
        return self._hopping(known)

    def _hopping(self, known: SparseProgress) -> SparseProgress:
        """Ask for a point close by, and samples around it."""
        return replace(
            known,
            home=replace(known, home=None, points=known.points[:0], outputs=known.outputs[:0]),
            output=known.output[:0],
            loss=math.inf,
            radius=self.radius,
            sigma=self.distance(self.radius),
            phase="sample",
            samples=self.own.samples,
            slow=0,
            finished=False,
            patient=False,
        )

    def _returned(self, known: SparseProgress) -> SparseProgress:
        """Return from a hop that has found nothing better; hop again if the search had arrived before."""
        home = known.home
        assert home is not None
        same = known.loss < math.inf and known.loss - home.loss <= _SAME * (known.hopped - home.loss)
        known = replace(home.taking(known, *_SHARED), phase="sample", patient=True)
        if not home.finished:
            return known
        known = known.agreeing(known.here, self.settings.tolerance) if same else known.with_arrivals(agreed=0)
        known = super().arrived(known)
        return known if known.done else self._hopping(known)

    def distance(self, radius: float) -> float:
        return min(1.0, max(self.own.share * radius, self.own.least_sigma))

    def promise(self, known: SparseProgress) -> float:
        """Return the promise of a step; it is infinite while a hop has led to nothing better."""
        if not known.predicts or known.failed or known.phase != "trial":
            return math.inf
        return super().promise(known)
