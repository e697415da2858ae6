"""The choice of a search by the number of parameters, their bounds, and the evaluations."""

from __future__ import annotations  # signatures print names of types, not what they stand for

from collections.abc import Callable
from typing import Any, Literal, get_args

from torch import Tensor

from torch_zerohess.search.descent.search import descent_method
from torch_zerohess.search.descent_and_gaussian_process import DescentAndProcess, TurnsProgress
from torch_zerohess.search.gaussian_process.search import process_method
from torch_zerohess.search.protocol.ask_tell import AskTell
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.space import Bounds, Vector
from torch_zerohess.search.sparse.noisy_method import sparse_method
from torch_zerohess.search.sparse.settings import SPARSE_TOLERANCE, SparseSearchSettings
from torch_zerohess.search.sparse_or_dense import FEWEST, SparseOrDense, SparseOrDenseProgress

_TOLERANCE = 1e-2
"""Length, in units of the first sigma, below which a search has arrived, if the caller says nothing."""
_MOST = 4
"""Parameters up to which random candidates cover a box."""

Engine = Literal["auto", "gaussian_process", "descent", "local"]
ENGINES: tuple[str, ...] = get_args(Engine)


class TrustRegion(AskTell[Any]):
    """A search that counts evaluations: `GaussianProcessSearch`, `Descent` or `LocalGaussNewton`. The caller evaluates.

    - Up to four parameters in a finite box: a Gaussian process, which escapes plateaus and local minima.
    - 5 to 19 parameters in a finite box, an output and a `loss`, `restarts`, and no `noise`: descent and the Gaussian
      process in turn. Descent begins, and stays where its Gauss-Newton makes good steps. Elsewhere the process has its
      turn when n + 1 evaluations of the descent take away less than a fifth of the loss. The descent has its turn again
      when 8 (n + 1) evaluations of the process take away less than a tenth.
    - 20 parameters or more, an output of many numbers and a `loss`: the evaluations show whether these numbers depend
      on few parameters each. If they do: Gauss-Newton on a sparse Jacobian. The search asks this after its first batch
      and, where the answer is not clear, each time that its evaluations have doubled.
    - Otherwise: descent by quadratic models in a trust region tied to sigma.

    `engine` says what was chosen, `reason` why. See the three classes for what they do.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: smoothing at the start, in units of the parameters: of the order of the distance to the solution.
            One value, or one per parameter [n] where they have different units; at most the width of its bounds.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch: `.double()`
            networks in it. None if the black box returns the loss.
        engine: "auto", "gaussian_process", "descent" or "local".
        restarts: how often to go on after the search has arrived at a minimum. 0 for a local search.
        tolerance: length, in units of the first sigma, below which the search has arrived; 0.01 if None, for the
            engine "local" 0.0005.
        noise: standard deviation of repeated losses at one point, if it is known. The engine "local", and descent on
            an output, use only whether it is above 0.
        pool: evaluations kept; a default by the number of parameters if None. Not for the engine "local".
        grid: rows and columns in which the parameters lie, for the engine "local": see `LocalGaussNewton`.
        seed: of the samples; from torch's global generator if None.

    Raises ValueError for settings out of range, TypeError for settings of another type.

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

    def __init__(
        self,
        x0: Vector,
        *,
        sigma: float | Vector,
        bounds: Bounds | None = None,
        loss: Callable[[Tensor], Tensor] | None = None,
        engine: Engine = "auto",
        restarts: int = 10,
        tolerance: float | None = None,
        noise: float = 0.0,
        pool: int | None = None,
        grid: tuple[int, ...] | None = None,
        seed: int | None = None,
    ) -> None:
        if engine not in ENGINES:
            raise ValueError(f"engine must be one of {ENGINES}, got {engine!r}")
        self._wanted, self._grid, self._tolerance = engine, grid, tolerance
        super().__init__(
            x0,
            sigma=sigma,
            bounds=bounds,
            loss=loss,
            restarts=restarts,
            tolerance=_TOLERANCE if tolerance is None else tolerance,
            noise=noise,
            pool=pool,
            seed=seed,
        )

    @property
    def engine(self) -> str:
        """Which search it is: "gaussian_process", "descent" or "local"; the one whose turn it is, where two take turns.

        "descent" as long as it is not decided.
        """
        known = self._state.progress
        if isinstance(known, SparseOrDenseProgress):
            return known.chosen or "descent"
        return known.engine if isinstance(known, TurnsProgress) else self._method.engine

    @property
    def reason(self) -> str:
        """Why this engine, in a sentence."""
        known = self._state.progress
        if isinstance(known, TurnsProgress) and known.process is not None:
            return "descent gained little, or arrived at another minimum than the lowest"
        return known.reason if isinstance(known, SparseOrDenseProgress) else self._reason

    def _make(self, settings: Settings) -> Method[Any]:
        if self._grid is not None and self._wanted in ("descent", "gaussian_process"):
            raise ValueError(f"grid is for the engines 'local' and 'auto', got {self._grid} with {self._wanted!r}")
        if settings.pool is not None and self._wanted == "local":
            raise ValueError(f"pool is for the other engines, got {settings.pool} with 'local'")
        engine, self._reason = _chosen(settings) if self._wanted == "auto" else (self._wanted, "the caller chose it")
        if engine == "gaussian_process":
            return process_method(settings)
        if self._wanted == "descent":
            return descent_method(settings)
        if engine == "descent" and (settings.loss is None or settings.n < FEWEST):
            hands_over = settings.loss is not None and settings.bounded and settings.restarts and not settings.noise
            return DescentAndProcess(settings) if hands_over else descent_method(settings)
        tolerance = SPARSE_TOLERANCE if self._tolerance is None else settings.tolerance
        own = SparseSearchSettings.checked(settings, grid=self._grid)
        sparse = sparse_method(replace(settings, tolerance=tolerance), own)
        return sparse if engine == "local" else SparseOrDense(settings, sparse)


def _chosen(settings: Settings) -> tuple[str, str]:
    """Return the engine and why."""
    n = settings.n
    if not settings.bounded:
        return "descent", "not every parameter has finite bounds"
    if n > _MOST:
        return "descent", f"a Gaussian process covers a box of up to {_MOST} parameters, and there are {n}"
    return "gaussian_process", f"a Gaussian process covers a finite box of {n} parameter{'s' if n > 1 else ''}"
