"""Second-order optimizers: for losses that carry a graph, and for black boxes whose evaluations the caller owns."""

from torch_zerohess.autograd.sample_jacobian import SampleJacobian
from torch_zerohess.optim.move_outputs import move_outputs
from torch_zerohess.optim.newton import Newton
from torch_zerohess.optim.newton_cg import NewtonCG
from torch_zerohess.optim.newton_targets import NewtonTargets
from torch_zerohess.optim.nonlinear_cg import NonlinearCG
from torch_zerohess.search.descent.search import Descent
from torch_zerohess.search.gauss_newton.block import BlockGaussNewton
from torch_zerohess.search.gaussian_process.search import GaussianProcessSearch
from torch_zerohess.search.sparse.search import LocalGaussNewton
from torch_zerohess.search.trust_region import TrustRegion

__all__ = [
    "BlockGaussNewton",
    "Descent",
    "GaussianProcessSearch",
    "LocalGaussNewton",
    "Newton",
    "NewtonCG",
    "NewtonTargets",
    "NonlinearCG",
    "SampleJacobian",
    "TrustRegion",
    "move_outputs",
]
