"""What the layers share: a black box, and settings that are checked whenever they are set."""

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor, nn

from torch_zerohess.arguments import check_state
from torch_zerohess.autograd.packed_state import packed, unpacked
from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.smoothing import Smoothing, check_smoothing, settings_of, smoothing_of
from torch_zerohess.surrogates.memory import Memory


class Layer(nn.Module):
    """A module around a black box."""

    smoothing: Smoothing
    """How to sample; another one may be set between calls."""
    call: BlackBoxCall
    """The black box, and how it is called."""
    memory: Memory | None = None
    """Evaluations that are kept, if any are."""

    def __setattr__(self, name: str, value: Any) -> None:
        if name == "smoothing":
            check_smoothing(value)
        super().__setattr__(name, value)

    @property
    def fn(self) -> Callable[..., Any]:
        """The black box itself."""
        return self.call.fn

    def get_extra_state(self) -> Tensor:
        """Return the settings, so that a state_dict resumes an annealed sigma, and what the memory keeps, as bytes."""
        settings = settings_of(self.smoothing)
        if self.memory is None or not self.memory.persistent:
            return packed(settings)
        return packed({**settings, "memory": self.memory.state_dict()}, self.memory.points.device)

    def set_extra_state(self, state: Any) -> None:
        """Take what `get_extra_state` has returned."""
        what, state = f"a {type(self).__name__}", unpacked(state)
        check_state(state, {}, what)
        settings = dict(state)
        memory = settings.pop("memory", None)
        if memory is not None and self.memory is None:
            raise ValueError("the state has a memory, but the layer has none: make it with memory=Memory()")
        smoothing = smoothing_of(settings, what)
        if memory is not None and self.memory is not None:
            self.memory.load_state_dict(memory)
        self.smoothing = smoothing  # after what may fail

    def _load_from_state_dict(
        self,
        state_dict: Mapping[str, Any],
        prefix: str,
        local_metadata: Any,
        strict: bool,
        missing: list[str],
        unexpected: list[str],
        errors: list[str],
    ) -> None:
        """Load as torch does. A memory that the layer has not is unexpected, hence left out with strict=False."""
        key = f"{prefix}_extra_state"
        state = unpacked(state_dict[key]) if self.memory is None and key in state_dict else None
        if isinstance(state, Mapping) and "memory" in state:
            state_dict = {**state_dict, key: {name: state[name] for name in state if name != "memory"}}
            unexpected.append(f"{key} with a memory: make the layer with memory=Memory()")
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, missing, unexpected, errors)

    def extra_repr(self) -> str:
        return f"{getattr(self.call.fn, '__name__', self.call.fn)!s}, {self.smoothing}"
