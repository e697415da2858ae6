"""Settings that only the search by a sparse Jacobian has."""

import math
from dataclasses import dataclass
from typing import Any

from torch_zerohess.arguments import checked_integer, checked_number
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.surrogates.sparse_fit import SparseSettings, check_samples

SPARSE_TOLERANCE = 5e-4
"""Radius, in units of sigma, at which the search has arrived, if the caller says nothing."""


@dataclass(frozen=True)
class SparseSearchSettings:
    """Settings that only this search has; see `LocalGaussNewton`."""

    sparse: SparseSettings
    samples: int = 32
    radius: float = 0.5
    share: float = 0.35
    least_sigma: float = 0.03

    @classmethod
    def checked(
        cls,
        settings: Settings,
        *,
        keep: int | None = None,
        rate: float = 0.1,
        grid: tuple[int, ...] | None = None,
        **own: Any,
    ) -> "SparseSearchSettings":
        """Check what a caller gave; ValueError for a setting out of range."""
        if not callable(settings.loss):
            raise ValueError(
                f"loss must be a function of one output for the engine 'local', got {settings.loss!r}: without one use "
                "engine='descent'"
            )
        sparse = SparseSettings.checked(settings.n, keep=keep, rate=rate, grid=grid)
        result = cls(replace(sparse, robust=False, grows=keep is None), **own)  # samples have one variance
        for name, most in (("radius", math.inf), ("share", 1.0), ("least_sigma", 1.0)):
            checked_number(name, getattr(result, name), above=0.0, most=most, below=math.inf)
        check_samples(checked_integer("samples", result.samples, 1), result.sparse.keep)
        return result
