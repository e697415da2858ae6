"""What the layers share: a black box, and settings that are checked whenever they are set."""

from collections.abc import Callable
from typing import Any

from torch import nn

from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.smoothing import Smoothing, check_smoothing


class Layer(nn.Module):
    """A module around a black box."""

    smoothing: Smoothing
    """How to sample; another one may be set between calls."""
    call: BlackBoxCall
    """The black box, and how it is called."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "smoothing":
            check_smoothing(value)
        super().__setattr__(name, value)

    @property
    def fn(self) -> Callable[..., Any]:
        """The black box itself."""
        return self.call.fn

    def extra_repr(self) -> str:
        return f"{getattr(self.call.fn, '__name__', self.call.fn)!s}, {self.smoothing}"
