"""Sigma annealing with the interface of a learning-rate schedule."""

from collections.abc import Iterable, Mapping
from typing import Any

from torch import Tensor, nn

from torch_zerohess.arguments import check_state, checked_integer, checked_sigma
from torch_zerohess.autograd.blackbox import BlackBox
from torch_zerohess.autograd.sparse_layer import SparseBlackBox


class LinearSigma:
    """Move sigma of one or several layers linearly from `start` to `end` in `steps` steps, after `hold` at the start.

    Large sigmas cross plateaus, small ones find the minimum. As with a scheduler of torch, making it sets the first
    value, each `step()` the next, `get_last_sigma()` returns it, and `state_dict` / `load_state_dict` resume it.
    It has no optimizer, so `ChainedScheduler` and `SequentialLR` of torch refuse it: call its `step()` beside theirs.

    Args:
        module_or_modules: a `BlackBox` or `SparseBlackBox`, a module that contains some, or several of either.
        start, end: sigma in units of the black box's input, positive: numbers, or tensors [n], one sigma per parameter.
            Each parameter goes from its own start to its own end; a number beside a tensor is that of all parameters.
            A layer whose sigma is a tensor needs a tensor.
        steps: number of `step()` calls from start to end, at least 1.
        hold: number of `step()` calls before that.

    Example:
        >>> from torch_zerohess import Smoothing
        >>> layer = BlackBox(lambda z: z.sum(1), Smoothing(sigma=1.0))
        >>> schedule = LinearSigma(layer, 1.0, 0.5, steps=2)
        >>> schedule.step()
        >>> layer.smoothing.sigma
        0.75
    """

    def __init__(
        self,
        module_or_modules: nn.Module | Iterable[nn.Module],
        start: float | Tensor,
        end: float | Tensor,
        steps: int,
        hold: int = 0,
    ) -> None:
        self._layers = _layers_of(module_or_modules)
        self._take({"start": start, "end": end, "steps": steps, "hold": hold, "count": 0})

    @property
    def sigma(self) -> float | Tensor:
        """The current sigma, a number or float64 [n]."""
        share = min(max(self.count - self.hold, 0) / self.steps, 1.0)
        return (1.0 - share) * self.start + share * self.end  # without rounding at both ends

    def get_last_sigma(self) -> list[float | Tensor]:
        """Return the sigma that the last step set, once per layer, as `get_last_lr` of a scheduler of torch does."""
        return [self.sigma for _ in self._layers]

    def __repr__(self) -> str:
        return f"LinearSigma({self.start} to {self.end}, steps={self.steps}, hold={self.hold}, count={self.count})"

    def step(self) -> None:
        """Go on by one step; beyond the last, sigma stays at its end."""
        self.count += 1
        self._apply()

    def state_dict(self) -> dict[str, Any]:
        """Return where the schedule is, without the layers."""
        state = {name: getattr(self, name) for name in ("start", "end", "steps", "hold", "count")}
        return {name: one.clone() if isinstance(one, Tensor) else one for name, one in state.items()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume and set the sigma of the layers. Raises as `LinearSigma` for numbers out of their range."""
        check_state(state, self.state_dict(), "a schedule")
        self._take(state)

    def _take(self, state: Mapping[str, Any]) -> None:
        start, end = (checked_sigma(state[name], name) for name in ("start", "end"))
        if isinstance(start, Tensor) and isinstance(end, Tensor):
            if len(end) != len(start):
                raise ValueError(f"end must have one sigma per parameter, as start has {len(start)}, got {len(end)}")
            end = end.to(start.device)
        self._check_lengths(start, end)
        steps = checked_integer("steps", state["steps"], 1)
        hold, count = (checked_integer(name, state[name], 0) for name in ("hold", "count"))
        self.start, self.end, self.steps, self.hold, self.count = start, end, steps, hold, count
        self._apply()

    def _check_lengths(self, start: float | Tensor, end: float | Tensor) -> None:
        """Raise ValueError for a layer with another number of sigmas."""
        name, longer = ("start", start) if isinstance(start, Tensor) or isinstance(end, float) else ("end", end)
        for one in self._layers:
            now = one.smoothing.sigma
            if isinstance(now, Tensor) and not (isinstance(longer, Tensor) and len(longer) == len(now)):
                got = f"got {len(longer)}" if isinstance(longer, Tensor) else f"got the number {longer}"
                raise ValueError(f"{name} must have one sigma per parameter, as a layer has {len(now)}, {got}")

    def _apply(self) -> None:
        for one in self._layers:
            one.smoothing = one.smoothing.replace(sigma=self.sigma)


def _layers_of(module_or_modules: nn.Module | Iterable[nn.Module]) -> list[BlackBox | SparseBlackBox]:
    """Return the black boxes in modules, each once."""
    single = isinstance(module_or_modules, nn.Module) or not isinstance(module_or_modules, Iterable)
    modules: list[Any] = [module_or_modules] if single else [*module_or_modules]  # type: ignore[misc]
    found: dict[BlackBox | SparseBlackBox, None] = {}
    for one in modules:
        parts = one.modules() if isinstance(one, nn.Module) else []
        inside = [part for part in parts if isinstance(part, (BlackBox, SparseBlackBox))]
        if not inside:
            raise TypeError(f"module_or_modules must be a (Sparse)BlackBox, or modules with one inside, got {one!r}")
        found.update(dict.fromkeys(inside))
    if not found:
        raise TypeError(f"module_or_modules must have at least one BlackBox, got {module_or_modules!r}")
    return list(found)
