"""Evaluations that are kept, and the surrogate fitted to them: a control variate for later estimates."""

import threading
from typing import Any

import torch
from torch import Tensor, nn

from torch_zerohess.arguments import check_state, checked_bool, checked_integer, checked_order
from torch_zerohess.precision import without_autocast
from torch_zerohess.surrogates.automatic import AutomaticSurrogate
from torch_zerohess.surrogates.checked_setting import CheckedSetting
from torch_zerohess.surrogates.coefficient import Coefficient
from torch_zerohess.surrogates.locking import locked
from torch_zerohess.surrogates.surrogate import Surrogate, check_surrogate, floating, outside_inference
from torch_zerohess.surrogates.thinning import farthest_from_later
from torch_zerohess.version import VERSION

_GROWTH = 1.3
"""The surrogate is fitted again when there are this times as many evaluations as at the last fit."""
_FEWEST = 8
"""Evaluations at the first fit, and the least capacity: with less there would never be a fit."""
_KEPT = 0.9
"""Share of the capacity that thinning leaves: it takes long, and must not follow every call."""
_ALL = 1 << 62
"""Capacity of the memory's own surrogate, which is fitted to all evaluations that are kept."""


class Memory:
    """Evaluations of a black box, and a surrogate g of it, as a control variate of `BlackBox` and `estimate`.

    Several of them can share one memory, and `minimize` adds to it. All must call the same black box. Another thread
    that reads evaluations or the state waits for the end of a call.

    With a head h after the black box f and a coefficient c,

        F(x, r) = c E h(g(x + sigma u), r)  +  E[ h(f(x + sigma u), r) - c h(g(x + sigma u), r) ].

    The first term takes no evaluations; its derivatives come from h and g. The second term is estimated from the
    evaluations of this call. g and c come from earlier calls, hence the estimate is unbiased for every g, but for
    `heads.LocalEntropy`. A bad g costs variance, and c falls to zero. A `Smoothing` with a fixed seed draws other
    samples at every call that adds evaluations: g would explain the old samples too well. With another number of
    threads of torch the fit of g differs by rounding, and so does the estimate.

    Torch differentiates the first term as far as h(g(z), r) is smooth in z, and Stein's identity does the rest: the
    second derivatives where slopes jump (an absolute error, ReLUs), and all of them where values jump (a threshold, a
    tree, a table) or torch knows no derivative (NumPy). A head of yours that takes outputs of more than 256 numbers
    gives second derivatives by Stein's identity, too, where that saves more time than it adds variance. A head or a
    surrogate of yours is tested for kinks and jumps at every call, along up to 32 random segments. Kinks that are so
    rare that no segment meets them stay unseen in that call.

    Args:
        surrogate: an object with `fit(points [P, n], outputs [P, *out])` and a differentiable
            `__call__(z [K, n]) -> [K, *out]`; an `nn.Module` without `fit`, which the caller trains; or None: a
            Gaussian process or an affine map, of the coordinates of large outputs, chosen by held-out evaluations. An
            affine map of hundreds of parameters is sparse where its outputs depend on few of them each. The layer gives
            the parameters of a module no gradient. Do not call the module in another thread during a call of the layer.
            It calls a module in evaluation mode, whatever its mode is, and leaves mode and buffers as they are.
            ValueError at the first call after a fit if outputs at the same points differ, as behind a dropout by
            `torch.nn.functional`, which draws in evaluation mode, too.
        capacity: evaluations that are kept, at least 8: with fewer nothing is fitted. Beyond it a tenth is dropped: of
            points that are close to each other the older. Outputs stay in memory as they are: 4 000 images of 64 x 64 x
            3 float32 numbers take 200 MB.
        fresh: how many elements of a batch get new evaluations per call, drawn at random and weighted by B / fresh.
            Values then have noise, so `optim.NewtonCG` and `optim.Newton` need adapt=False, and a nonlinear loss behind
            the layer has biased gradients: give it as `head`. None: all of them. 0: none; the estimate is then the
            first term alone, and biased towards g. Under `vmap` each element is a batch of its
            own: all of them get new evaluations, unless there are none.
        order: highest derivative that new evaluations enter. 1: second derivatives come from the surrogate alone,
            without noise, and biased towards it; values and gradients stay unbiased.
        draws: points per element at which the surrogate's term is evaluated, at least 3. None: for more than 32
            parameters 4, or 64 with kinks or jumps; for fewer 1024 / B and at least 64. A head of yours that takes
            outputs of more than 256 numbers, and has slopes, gets 256 / B and at least 32: it takes most of the time.
            An affine surrogate under `heads.SquaredError` needs none in a layer: the expectation is known.
        persistent: whether the `state_dict` of a layer has the evaluations. `Memory.state_dict` always has them.

    All but the surrogate may be set between calls.

    Raises:
        TypeError, ValueError: an argument is not as described.

    Example:
        >>> memory = Memory()
        >>> z = torch.linspace(-2, 2, 30)[:, None]
        >>> memory.add(z, z.square())
        >>> memory.fit()
        >>> memory.evaluations, abs(float(memory.surrogate(torch.tensor([[1.0]]))) - 1.0) < 0.01
        (30, True)
    """

    capacity = CheckedSetting(lambda value: checked_integer("capacity", value, _FEWEST), lambda memory: memory._thin())
    fresh = CheckedSetting(lambda value: None if value is None else checked_integer("fresh", value, 0))
    order = CheckedSetting(checked_order)
    draws = CheckedSetting(lambda value: None if value is None else checked_integer("draws", value, 3))
    persistent = CheckedSetting(lambda value: checked_bool("persistent", value))

    def __init__(
        self,
        surrogate: Surrogate | nn.Module | None = None,
        *,
        capacity: int = 4000,
        fresh: int | None = None,
        order: int = 2,
        draws: int | None = None,
        persistent: bool = True,
    ) -> None:
        self._points: list[Tensor] = []
        self._outputs: list[Tensor] = []
        self._size = 0
        self.lock = threading.RLock()
        """Held during a call, so that the surrogate does not change in it, and by what reads or changes evaluations."""
        self.capacity, self.fresh, self.order, self.draws, self.persistent = capacity, fresh, order, draws, persistent
        check_surrogate(surrogate)
        self.surrogate: Any = AutomaticSurrogate(capacity=_ALL) if surrogate is None else surrogate  # all of them
        self.evaluations = 0
        """Evaluations taken so far, those that are no longer kept included."""
        self.pathwise: int | None = None
        """Orders of pathwise derivatives of the surrogate's term, see `estimation.surrogate_term`; None: not known."""
        self._fitted = 0
        """Evaluations taken at the last fit."""
        self._rows = self._known = 0
        """How many evaluations the last fit knew: of those that are kept, which come first, and in all."""
        self.regression = Coefficient()
        """What earlier calls show about the surrogate."""

    def __len__(self) -> int:
        """Evaluations that are kept."""
        return self._size

    def __bool__(self) -> bool:
        """True, also of a memory that is empty: `if memory` asks whether there is one."""
        return True

    @property
    @locked
    def points(self) -> Tensor:
        """Points of the evaluations that are kept, [P, n]; not a copy: clone it before you change it."""
        self._points = _joined(self._points)
        return self._points[0] if self._points else torch.empty(0, 0, device="cpu")

    @property
    @locked
    def outputs(self) -> Tensor:
        """Outputs there, [P, *out]; not a copy, either."""
        self._outputs = _joined(self._outputs)
        return self._outputs[0] if self._outputs else torch.empty(0, device="cpu")

    @property
    def output_shape(self) -> torch.Size | None:
        """Shape of one output, *out; None before the first evaluation."""
        return self._outputs[0].shape[1:] if self._outputs else None

    def check_parameters(self, n: int) -> None:
        """Raise ValueError if the evaluations that are kept are of another number of parameters."""
        if self._points and (kept := self._points[0].shape[1]) != n:
            raise ValueError(f"x must have {kept} parameters like the evaluations in memory, got {n}")

    @locked
    def add(self, points: Tensor, outputs: Tensor) -> None:
        """Keep outputs [K, *out] at points [K, n]; those that are not finite are left out.

        Integers and truth values become float64, as what fn returns. Raises ValueError if a shape differs from the
        shapes of earlier evaluations, TypeError for what is no tensor of real numbers.
        """
        for name, one in (("points", points), ("outputs", outputs)):
            if not isinstance(one, Tensor):
                raise TypeError(f"{name} must be a tensor, got {type(one).__name__}")
        if points.dim() != 2 or outputs.dim() < 1 or len(points) != len(outputs):
            raise ValueError(
                f"points must be [K, n] and outputs [K, *out], got {list(points.shape)} and {list(outputs.shape)}"
            )
        for name, new, kept in (("points", points, self._points), ("outputs", outputs, self._outputs)):
            if kept and new.shape[1:] != kept[0].shape[1:]:
                wanted = ", ".join(map(str, ("K", *kept[0].shape[1:])))
                raise ValueError(f"{name} must be [{wanted}] like the earlier ones, got {list(new.shape)}")
        points, outputs = floating("points", points), floating("outputs", outputs)
        finite = torch.isfinite(points).all(1) & torch.isfinite(outputs.reshape(len(outputs), -1)).all(1)
        self.evaluations += len(points)
        if not bool(finite.any()):
            return
        with outside_inference():
            self._points.append(points[finite])
            self._outputs.append(outputs[finite])
        self._size += len(self._points[-1])
        self._thin()

    @locked
    def fit(self) -> None:
        """Fit the surrogate to all evaluations that are kept; a module without `fit` is left as it is.

        A layer uses it after a later call in training mode, or of `estimate`, which learns the coefficient. Raises
        ValueError if there are fewer than two evaluations.
        """
        if self._size < 2:
            raise ValueError(f"a surrogate is fitted to at least 2 evaluations, the memory has {self._size}: add some")
        self._rows = self._known = self._size
        self._fit_rows()
        self._fitted, self.pathwise = self.evaluations, None

    def _fit_rows(self) -> None:
        if hasattr(self.surrogate, "fit"):
            # With grad: a surrogate may train itself by gradient descent, also where the caller wants no derivatives.
            with outside_inference(), torch.enable_grad(), without_autocast(self.points.device):
                points, outputs = self.points[: self._rows], self.outputs[: self._rows]
                if type(self.surrogate) is not AutomaticSurrogate:  # another one may change them in place
                    points, outputs = points.clone(), outputs.clone()
                self.surrogate.fit(points, outputs)

    @locked
    def refresh(self) -> None:
        """Fit the surrogate if that is due: `evaluations` has grown by 30 % since the last fit."""
        if self._size >= _FEWEST and self.evaluations >= _GROWTH * self._fitted:
            self.fit()

    @property
    def ready(self) -> bool:
        """Whether the surrogate can predict."""
        return self._fitted > 0 or not hasattr(self.surrogate, "fit")

    @property
    def coefficient(self) -> float:
        """Coefficient c in [0, 1] of the surrogate's values in the next call; see `Coefficient`."""
        return 1.0 if self.fresh == 0 else self.regression.value

    @locked
    def _thin(self) -> None:
        """Drop points down to a share of the capacity, if there are more than the capacity."""
        if self._size <= self.capacity:
            return
        first = max(self._size - 2 * self.capacity, 0)  # older ones go first, so that distances are few
        kept = first + farthest_from_later(self.points[first:], max(_FEWEST, int(_KEPT * self.capacity)))
        with outside_inference():
            self._points, self._outputs = [self.points[kept]], [self.outputs[kept]]
        self._size, self._rows = len(kept), int((kept < self._rows).sum())

    @locked
    def state_dict(self) -> dict[str, Any]:
        """Return everything but the settings: evaluations, the coefficient, and the state of the surrogate if any."""
        model = self.surrogate.state_dict() if isinstance(self.surrogate, nn.Module) else None
        return {
            "points": self.points,
            "outputs": self.outputs,
            "evaluations": self.evaluations,
            "fitted": self._fitted,
            "rows": self._rows,
            "known": self._known,
            "pathwise": self.pathwise,
            "moments": [list(one) for one in self.regression.moments],
            "surrogate": model,
            "version": VERSION,
        }

    @locked
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take the evaluations of `state_dict`; a surrogate that is no module is fitted to what it knew.

        It is fitted to all evaluations if the memory has dropped some that it knew. The coefficient is learned anew if
        only one of the two surrogates is a module.
        """
        check_state(state, self.state_dict(), "a memory")
        with outside_inference():  # the state may have been read in inference mode
            points, outputs = state["points"].clone(), state["outputs"].clone()
        self._points, self._outputs = ([points], [outputs]) if len(points) else ([], [])
        self._size, self.evaluations = len(points), state["evaluations"]
        self.regression.moments = [list(one) for one in state["moments"]]
        self._fitted, self._rows, self.pathwise = state["fitted"], state["rows"], state["pathwise"]
        self._known = state["known"]
        self._thin()
        if isinstance(self.surrogate, nn.Module) == (state["surrogate"] is None):
            self.regression.moments = []  # of a surrogate of another kind
        if isinstance(self.surrogate, nn.Module) and state["surrogate"] is not None:
            self.surrogate.load_state_dict(state["surrogate"])
        elif self._rows < self._known:
            self.fit()
        elif self._rows > 1:
            self._fit_rows()

    @locked
    def __getstate__(self) -> dict[str, Any]:
        found = {name: value for name, value in vars(self).items() if name != "lock"}
        return {**found, "_points": [*self._points], "_outputs": [*self._outputs]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, lock=threading.RLock())

    def __repr__(self) -> str:
        kept = f"{self._size} of {self.evaluations} evaluations, fresh={self.fresh}"
        return f"Memory({type(self.surrogate).__name__}, {kept}, coefficient={self.coefficient:.2f})"


def _joined(parts: list[Tensor]) -> list[Tensor]:
    with outside_inference():
        return [torch.cat(parts)] if len(parts) > 1 else parts


def check_memory(memory: Any) -> None:
    """Raise TypeError for an argument that is neither None nor a `Memory`."""
    if memory is not None and not isinstance(memory, Memory):
        raise TypeError(f"memory must be a Memory, got {type(memory).__name__}")
