"""Second-order optimizers for losses that carry a graph."""

from torch_zerohess.optim.newton_cg import NewtonCG

__all__ = ["NewtonCG"]
