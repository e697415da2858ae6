"""Models fitted to evaluations; they never ask for points."""

from torch_zerohess.surrogates.automatic import AutomaticSurrogate
from torch_zerohess.surrogates.gaussian_process_surrogate import ProcessSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.low_rank import LowRankSurrogate
from torch_zerohess.surrogates.sparse_surrogate import SparseSurrogate
from torch_zerohess.surrogates.surrogate import Surrogate

__all__ = [
    "AutomaticSurrogate",
    "LinearSurrogate",
    "LowRankSurrogate",
    "ProcessSurrogate",
    "SparseSurrogate",
    "Surrogate",
]
