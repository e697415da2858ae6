"""The best point so far, as the methods of other packages report it."""

import math

import numpy as np
import torch
from numpy.typing import NDArray

from experiments.runs.trial import Trial

Array = NDArray[np.float64]


class Best:
    """The best point evaluated so far, which is what gets reported."""

    def __init__(self, trial: Trial) -> None:
        self._trial = trial
        self.x, self.value = trial.start, math.inf

    def __call__(self, points: Array, values: Array, *, sigma: float | None = None) -> None:
        """Report after points [K, n] with values [K]."""
        k = int(np.argmin(np.where(np.isnan(values), np.inf, values)))
        if values[k] < self.value:
            self.x, self.value = torch.tensor(points[k], dtype=torch.float64), float(values[k])
        self._trial.report(self.x, sigma=sigma, loss=self.value)
