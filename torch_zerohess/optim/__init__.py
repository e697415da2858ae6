"""Second-order optimizers: for losses that carry a graph, and for black boxes whose evaluations the caller owns."""

from torch_zerohess.optim.newton import Newton
from torch_zerohess.optim.newton_cg import NewtonCG
from torch_zerohess.optim.nonlinear_cg import NonlinearCG
from torch_zerohess.search.trust_region import TrustRegion

__all__ = ["Newton", "NewtonCG", "NonlinearCG", "TrustRegion"]
