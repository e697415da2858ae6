"""Any black-box function, differentiable to second order inside PyTorch.

The function is convolved with a Gaussian, F(x) = E f(x + sigma u), u ~ N(0, I); value, gradient, Hessian and
Hessian-vector products of F are estimated from one batch of evaluations of f (Stein's identities) and enter autograd:

    import torch_zerohess as zh

    layer = zh.BlackBox(render_loss, zh.Smoothing(sigma=0.1))   # [*batch, n] -> [*batch]
    loss = layer(network(image)).mean()                         # white box, then black box
    loss.backward()                                             # or torch.func, or zh.optim.NewtonCG
"""

from torch_zerohess import adapters, evaluators, heads, losses, optim, surrogates
from torch_zerohess.autograd.blackbox import BlackBox, smooth
from torch_zerohess.autograd.curvature import CurvatureOperator, hvp
from torch_zerohess.autograd.sparse_layer import SparseBlackBox
from torch_zerohess.doctor import Report, doctor
from torch_zerohess.estimation.estimate import estimate
from torch_zerohess.estimation.finite_differences import finite_difference_hvp
from torch_zerohess.estimation.result import ConfidenceInterval, Estimate
from torch_zerohess.estimation.sparse_jacobian import sparse_jacobian
from torch_zerohess.minimize import Iterate, Minimum, Observation, minimize
from torch_zerohess.optim.schedules import LinearSigma
from torch_zerohess.smoothing import Smoothing
from torch_zerohess.surrogates.memory import Memory
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian
from torch_zerohess.version import VERSION as __version__

__all__ = [
    "BlackBox",
    "ConfidenceInterval",
    "CurvatureOperator",
    "Estimate",
    "Iterate",
    "LinearSigma",
    "Memory",
    "Minimum",
    "Observation",
    "Report",
    "Smoothing",
    "SparseBlackBox",
    "SparseJacobian",
    "__version__",
    "adapters",
    "doctor",
    "estimate",
    "evaluators",
    "finite_difference_hvp",
    "heads",
    "hvp",
    "losses",
    "minimize",
    "optim",
    "smooth",
    "sparse_jacobian",
    "surrogates",
]
