"""torch_zerohess."""
from torch_zerohess.estimate import Estimate, estimate
from torch_zerohess.smoothing import Smoothing
from torch_zerohess.blackbox import BlackBox, smooth
