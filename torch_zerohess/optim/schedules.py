"""Sigma annealing with the interface of a learning-rate schedule."""

from collections.abc import Iterable
from typing import Any

from torch_zerohess.autograd.blackbox import BlackBox


class LinearSigma:
    """Move sigma of one or several layers linearly from `start` to `end` in `steps` steps, after `hold` at the start.

    Large sigmas cross plateaus, small ones find the minimum. As with a scheduler of torch, making it sets the first
    value, each `step()` the next, and `state_dict` / `load_state_dict` resume it.

    Args:
        modules: a `BlackBox` or several.
        start, end: sigma in units of the black box's input, positive.
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
        self, modules: BlackBox | Iterable[BlackBox], start: float, end: float, steps: int, hold: int = 0
    ) -> None:
        self._modules = [modules] if isinstance(modules, BlackBox) else list(modules)
        if not self._modules or not all(isinstance(one, BlackBox) for one in self._modules):
            raise TypeError(f"modules must be a BlackBox or several, got {modules!r}")
        for one in self._modules:
            if not isinstance(one.smoothing.sigma, float):
                raise ValueError(
                    f"modules must have one sigma for all parameters, got {one.smoothing.sigma}: scale the parameters "
                    "of the black box instead"
                )
        for name, value in (("start", start), ("end", end)):
            if not value > 0:
                raise ValueError(f"{name} must be a positive sigma, got {value}")
        if steps < 1 or hold < 0:
            raise ValueError(f"steps must be at least 1 and hold at least 0, got steps={steps}, hold={hold}")
        self.start, self.end, self.steps, self.hold, self.count = float(start), float(end), steps, hold, 0
        self._apply()

    @property
    def sigma(self) -> float:
        """The current sigma."""
        share = min(max(self.count - self.hold, 0) / self.steps, 1.0)
        return self.start + share * (self.end - self.start)

    def step(self) -> None:
        """Go on by one step; beyond the last, sigma stays at its end."""
        self.count += 1
        self._apply()

    def state_dict(self) -> dict[str, Any]:
        """Return where the schedule is, without the layers."""
        return {name: getattr(self, name) for name in ("start", "end", "steps", "hold", "count")}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume and set the sigma of the layers."""
        for name in ("start", "end", "steps", "hold", "count"):
            setattr(self, name, state[name])
        self._apply()

    def _apply(self) -> None:
        for one in self._modules:
            one.smoothing = one.smoothing.replace(sigma=self.sigma)
