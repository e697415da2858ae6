"""Steps that a border cuts short, and when a step may ignore the border.

The border is a plane, but the region that fails may be small, and the search may have passed it. Then steps that the
border cuts short keep their promise one after the other. A step without the border is tried after three of them. Each
such step that fails multiplies this number by four: a minimum on a true border costs a logarithm of the steps there.
"""

from dataclasses import dataclass, replace
from typing import Literal

from torch import Tensor

_FIRST, _MORE = 3, 4
"""Cut steps that keep their promise before a step first ignores the border, and the factor after one that fails."""
_CUT = 0.1
"""Distance between the ends of a step with and without a border, in units of the region, from which the border cuts it
short."""


@dataclass(frozen=True)
class CutSteps:
    """What has become of steps beside a border."""

    last: Literal["whole", "cut", "free"] = "whole"
    """Whether the border has cut the last step short, or the step has ignored it."""
    kept: int = 0
    """Cut steps that kept their promise, since the last step that failed."""
    needed: int = _FIRST
    """So many of them are needed before a step ignores the border."""

    def after(self, *, finite: bool, kept: bool) -> "CutSteps":
        """Return what is known after a step: whether its end has a finite value, and whether it kept its promise."""
        if not finite:
            return replace(self, kept=0, needed=_MORE * self.needed if self.last == "free" else self.needed)
        return replace(self, kept=self.kept + 1) if kept and self.last == "cut" else self

    def planned(self, u: Tensor, holes: Tensor, cut: Tensor, free: Tensor) -> "CutSteps":
        """Return whether the border cuts a step short, or the step ignores the border.

        A step ignores it only if its end is nearer to an evaluation with a value than to one without.

        Args:
            u: evaluations [P, n], in units of the region.
            holes: which of them have no value [P].
            cut: end of the step with the border [n].
            free: end of the step without it [n].
        """
        if float((free - cut).norm()) <= _CUT:
            return replace(self, last="whole")
        distance = (u - free).norm(dim=1)
        clear = float(distance[holes].min()) > float(distance[~holes].min())
        return replace(self, last="free" if clear and self.kept >= self.needed else "cut")
