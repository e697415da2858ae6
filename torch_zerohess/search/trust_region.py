"""The door to the searches: chooses one by the number of parameters and their bounds."""

from collections.abc import Callable, Sequence
from typing import Any, Literal

from torch import Tensor

from torch_zerohess.search.descent_search import descent_method
from torch_zerohess.search.gaussian_process_search import process_method
from torch_zerohess.search.protocol import AskTell, Method, Settings
from torch_zerohess.search.space import Bounds

_MOST = 4
"""Parameters up to which random candidates cover a box."""

Engine = Literal["auto", "gaussian_process", "descent"]
ENGINES = ("auto", "gaussian_process", "descent")


class TrustRegion(AskTell[Any]):
    """A search that counts evaluations: chooses between `GaussianProcessSearch` and `Descent`. The caller evaluates.

    - Up to four parameters in a finite box: a Gaussian process, which leaves plateaus and local minima.
    - Otherwise: descent by quadratic models in a trust region tied to sigma.

    `engine` says what was chosen, `reason` why. See the two classes for what they do.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: smoothing at the start, in units of the parameters: of the order of the distance to the solution.
            One value, or one per parameter [n] where they have different units.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch: `.double()`
            networks in it. None if the black box returns the loss.
        engine: "auto", "gaussian_process" or "descent".
        restarts: how often to go on after the search has arrived at a minimum. 0 for a local search.
        tolerance: length, in units of the first sigma, below which the search has arrived.
        noise: standard deviation of repeated losses at one point, if it is known.
        pool: evaluations kept; a default by the number of parameters if None.
        seed: of the samples; from torch's global generator if None.

    Raises ValueError for settings out of range.

    Example:
        >>> import torch
        >>> search = TrustRegion(torch.tensor([900.0, 850.0]), sigma=500.0, seed=0, restarts=0)
        >>> search.engine, search.reason
        ('descent', 'not every parameter has finite bounds')
        >>> while search.evaluations < 9:
        ...     z = search.ask()
        ...     search.tell(5 * z[:, 0] ** 2 + 5 * z[:, 1] ** 2 + 7.5 * z[:, 0] * z[:, 1])
        >>> search.value < 1.0  # of 1.3e7
        True
    """

    reason: str
    """Why this engine, in a sentence."""

    def __init__(
        self,
        x0: Tensor | Sequence[float],
        *,
        sigma: float | Tensor | Sequence[float],
        bounds: Bounds | None = None,
        loss: Callable[[Tensor], Tensor] | None = None,
        engine: Engine = "auto",
        restarts: int = 10,
        tolerance: float = 1e-2,
        noise: float = 0.0,
        pool: int | None = None,
        seed: int | None = None,
    ) -> None:
        if engine not in ENGINES:
            raise ValueError(f"engine must be one of {ENGINES}, got {engine!r}")
        self._wanted = engine
        super().__init__(
            x0,
            sigma=sigma,
            bounds=bounds,
            loss=loss,
            restarts=restarts,
            tolerance=tolerance,
            noise=noise,
            pool=pool,
            seed=seed,
        )

    def _make(self, settings: Settings) -> Method[Any]:
        engine, self.reason = _chosen(settings) if self._wanted == "auto" else (self._wanted, "the caller chose it")
        return descent_method(settings) if engine == "descent" else process_method(settings)


def _chosen(settings: Settings) -> tuple[str, str]:
    """Return the engine and why."""
    n = settings.n
    if not settings.bounded:
        return "descent", "not every parameter has finite bounds"
    if n > _MOST:
        return "descent", f"a Gaussian process covers a box of up to {_MOST} parameters, and there are {n}"
    return "gaussian_process", f"a Gaussian process covers a finite box of {n} parameter{'s'[: n > 1]}"
