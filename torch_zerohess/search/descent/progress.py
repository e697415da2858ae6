"""The progress of a descent between two evaluations."""

import math
from dataclasses import dataclass
from typing import Literal

from torch import Tensor

from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import Best, Progress
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel

BATCH = 64
"""Points asked for at a time, at most."""
WIDEST = 1.6
"""Sigma, in units of the first one, up to which plateaus and faithful models of the output widen it. Other good steps
may widen it further."""


@dataclass(frozen=True, eq=False, kw_only=True)
class DescentProgress(Progress):
    """A round of the descent: a pool, a model of it around the center, and its step."""

    pool: Pool
    phase: Literal["start", "sample", "trial"] = "start"
    """What is asked for: the center and samples, samples, or the end of a step."""
    value: float = math.inf
    """Loss at the center."""
    lowest: Best
    """The best point of this round."""
    model: LocalModel | None = None
    step: Tensor
    """Minimum of the model in its trust region [r]."""
    need: int = 0
    """Samples that are asked for; 0 once there is a model of them."""
    paired: bool = False
    """Whether these come in pairs x + d, x - d."""
    patience: int = 0
    """How often a plateau has been met in a row."""
    faithful: bool = False
    """Whether the model of the output has predicted well."""
    reach: float = 1.0
    """Radius of the trust region, in units of sigma sqrt(n)."""
    retries: int = 0
    """Shorter steps in a row without new samples."""
    misled: int = 0
    """How often in a row the model of the output was far off."""
    recent: tuple[float, ...] = ()
    """Smoothed losses of the latest steps."""
    earlier: float = math.inf
    """Lowest smoothed loss of the steps before these."""

    @property
    def n(self) -> int:
        """Number of parameters."""
        return len(self.center)

    @property
    def length(self) -> float:
        """Length of the step in units of sigma sqrt(n)."""
        return float(self.step.norm()) / math.sqrt(self.n)

    def sampling(self, count: int, *, paired: bool = True) -> "DescentProgress":
        """Ask for about `count` samples next."""
        return replace(self, phase="sample", need=min(count, BATCH), paired=paired and count > 1)

    def trying(self) -> "DescentProgress":
        """Ask for the end of a step next."""
        return replace(self, phase="trial")
