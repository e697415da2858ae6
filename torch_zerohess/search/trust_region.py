"""Minimise a black box by quadratic models of the smoothed function in a trust region tied to sigma: ask and tell."""

import math
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.search import gaussian_process_search as box_search
from torch_zerohess.search.descent import Search
from torch_zerohess.search.gaussian_process_search import BoxSearch
from torch_zerohess.search.loss_search import LossSearch
from torch_zerohess.surrogates.quadratic import LocalModel

_BOX_POOL = 60
"""Evaluations kept by a search in a box."""


class TrustRegion:
    """Second-order descent on a smoothed black box that counts evaluations. The caller evaluates.

    Each iteration fits a quadratic model of the smoothed loss to the pool of past evaluations (`Pool`, `fit_values`;
    `fit_outputs` if the black box returns a tensor and `loss` is given), minimises it within sigma sqrt(n) of x and
    within the bounds, and asks for that one point. New samples around x are asked for only where the model has
    predicted badly. Sigma, and with it the region, grows after a long good step and on a plateau, and shrinks after a
    short or refused one.

    - Up to four parameters, finite bounds: a Gaussian process predicts the output everywhere in the box, and the search
      looks where the `loss` may be lowest (`BoxSearch`); it leaves plateaus and local minima. So it does with the loss
      alone, and finishes with quadratics (`LossSearch`).
    - Otherwise, with the loss alone or n <= 2, it descends, and moves to whatever evaluated point is best.
    - Otherwise, with an output [K, *out] and a white-box `loss`, every evaluation is many equations: it follows the
      minimum of loss(E f) while sigma goes to zero, also where the loss itself rises for a while.

    Where sigma has become small the search has arrived at a minimum, possibly a local one. It then starts again, in
    turn from a random point and around the best one, with more samples per iteration, up to `restarts` times; in a box
    it is more optimistic for some steps, or, of the loss alone, looks where it knows least.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: smoothing at the start, in units of the parameters: of the order of the distance to the solution.
            One value, or one per parameter [n] where they have different units.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch: `.double()`
            networks in it. None if the black box returns the loss.
        restarts: how often to go on after arriving. 0 for a local search.
        tolerance: the search has arrived when sigma, or in a box the length of three steps in a row, is below this
            times the first sigma; quadratics of a `LossSearch` go on to a thousandth of that.
        noise: standard deviation of repeated losses at one point, if it is known. Smaller decreases do not count. In a
            box it is also told from outputs, after some 10 (n + 1) of them; in noise `x` is the point with the lowest
            loss of the predicted output, or lowest predicted loss, and `value` is that.
        pool: evaluations kept; by default 60 or 6 n, and enough for a full quadratic of a loss alone up to n = 20. In a
            box the time of an iteration grows with its third power.
        seed: of the samples; from torch's global generator if None.

    Raises ValueError for settings out of range. Source: Wang, Fischer and Ritschel (2025) for the smoothed second
    order; evaluations are re-used as in derivative-free least squares (Cartis et al. 2019) and COBYQA; a model of the
    output instead of the loss, with optimism, as in Bayesian optimization of composite functions (Astudillo and Frazier
    2019).

    Example:
        >>> search = TrustRegion(torch.tensor([900.0, 850.0]), sigma=500.0, seed=0, restarts=0)
        >>> while search.evaluations < 9:
        ...     z = search.ask()
        ...     search.tell(5 * z[:, 0] ** 2 + 5 * z[:, 1] ** 2 + 7.5 * z[:, 0] * z[:, 1])
        >>> search.value < 1.0  # of 1.3e7
        True
    """

    def __init__(
        self,
        x0: Tensor,
        *,
        sigma: float | Tensor,
        bounds: tuple[float | Tensor, float | Tensor] | None = None,
        loss: Callable[[Tensor], Tensor] | None = None,
        restarts: int = 10,
        tolerance: float = 1e-2,
        noise: float = 0.0,
        pool: int | None = None,
        seed: int | None = None,
    ) -> None:
        if not isinstance(x0, Tensor) or x0.dtype not in (torch.float32, torch.float64) or x0.ndim != 1 or not len(x0):
            raise ValueError(f"x0 must be a tensor [n], float32 or float64, got {x0!r}")
        if not bool(torch.isfinite(x0).all()):
            raise ValueError(f"x0 must be finite, got {x0}")
        for name, value in (("restarts", restarts), ("noise", noise)):
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and at least 0, got {value}")
        if not 0.0 < tolerance < 1.0:
            raise ValueError(f"tolerance must be between 0 and 1, got {tolerance}")
        if pool is not None and pool < 4:
            raise ValueError(f"pool must be at least 4, got {pool}")
        self.n, self.dtype, self.loss = len(x0), x0.dtype, loss
        # The search is in units of sigma: one sigma per parameter is a change of units.
        self._unit = _units(sigma, x0)
        self._bounds = _box(bounds, x0)
        generator = torch.Generator()
        generator.manual_seed(int(torch.randint(2**63 - 1, ())) if seed is None else seed)
        place = (x0.detach().double() / self._unit, *(one.double() / self._unit for one in self._bounds))
        boxed = self.n <= box_search.MOST and bool(torch.isfinite(torch.stack(self._bounds)).all())
        capacity = _BOX_POOL if boxed else _capacity(self.n, loss is None)
        settings: dict[str, Any] = {
            "restarts": restarts,
            "tolerance": tolerance,
            "noise": float(noise),
            "pool": pool or capacity,
            "generator": generator,
        }
        self._search: Search | BoxSearch
        if boxed:
            self._search = LossSearch(*place, **settings) if loss is None else BoxSearch(*place, loss=loss, **settings)
        else:
            self._search = Search(*place, loss=loss, **settings)
        self._asked: Tensor | None = None

    @property
    def x(self) -> Tensor:
        """The best point so far [n]."""
        return self._in_units(self._search.best)

    @property
    def value(self) -> float:
        """The loss there; infinite before the first `tell`."""
        return self._search.lowest

    @property
    def center(self) -> Tensor:
        """Where the search is now [n], not always its best point."""
        return self._in_units(self._search.x)

    @property
    def sigma(self) -> float:
        """Current smoothing, in units of the first one."""
        return self._search.sigma

    @property
    def unit(self) -> Tensor:
        """The first sigma per parameter [n]: what `sigma` and `LocalModel` are in units of."""
        return self._unit

    @property
    def evaluations(self) -> int:
        """Values told so far."""
        return self._search.evaluations

    @property
    def iterations(self) -> int:
        """Steps tried so far."""
        return self._search.iterations

    @property
    def rounds(self) -> int:
        """Times the search has arrived."""
        return self._search.rounds

    @property
    def done(self) -> bool:
        """Whether there is nothing more to ask."""
        return self._search.done

    @property
    def message(self) -> str:
        """Why the search is done."""
        return self._search.message

    def model_at_best(self) -> tuple[LocalModel, float] | None:
        """A model around `x` and its sigma, that of when x was found or wider if few evaluations are near.

        None if the pool has lost touch with x, or before the first `tell`.
        """
        return self._search.model_at_best()

    def ask(self, limit: int | None = None) -> Tensor:
        """Return the next points to evaluate [K, n], at most `limit` of them; the same ones until they are told."""
        if limit is not None and limit < 1:
            raise ValueError(f"limit must be at least 1, got {limit}")
        if self.done:
            raise RuntimeError(f"the search is done: {self.message}")
        if self._asked is None:
            self._asked = self._search.points()
            if self.dtype != torch.float64:  # what is evaluated is the rounded point
                self._asked = self._in_units(self._asked).double() / self._unit
        self._asked = self._asked[:limit]
        return self._in_units(self._asked)

    def tell(self, values: Any) -> None:
        """Take the values of the points that `ask` returned: [K], or [K, *out] if there is a `loss`.

        Values that are not finite are left out, and the step to such a point is refused and shortened, or in a box such
        points are taken for the worst. Raises ValueError for a wrong shape, or if the start itself has no finite value.
        The search is as before if this, or the loss, raises.
        """
        if self._asked is None:
            raise RuntimeError("ask for points before telling their values")
        before = self.state_dict()
        try:
            points, self._asked = self._asked, None
            losses, outputs = self._losses(values, points)
            if self.evaluations == 0 and not bool(torch.isfinite(losses[0])):
                raise ValueError(f"the black box is not finite at the start x0: {float(losses[0])}")
            self._search.take(points, losses, outputs)
        except BaseException:
            self.load_state_dict(before)
            raise

    def state_dict(self) -> dict[str, Any]:
        """Everything that a search with the same settings needs to go on exactly as this one would.

        Tensors, numbers, strings, lists and dicts: `torch.save`, and `torch.load` with weights_only=True.
        """
        kind = type(self._search).__name__
        return {"kind": kind, "unit": self._unit, "asked": self._asked, **self._search.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a `state_dict`; the settings and the loss stay those given here.

        ValueError if these do not go with it: other parameters, another sigma, or finite bounds there and not here.
        """
        unit, kind = state["unit"].to(self._unit), type(self._search).__name__
        if len(unit) != self.n:
            raise ValueError(f"state must be of a search with {self.n} parameters, got one with {len(unit)}")
        if not bool((unit == self._unit).all()):
            raise ValueError(f"state must be of a search with sigma = {self._unit.tolist()}, got {unit.tolist()}")
        if state["kind"] != kind:
            raise ValueError(
                f"state must be of a search with such bounds and loss as here ({kind}), got one of {state['kind']}"
            )
        self._asked = state["asked"]
        self._search.load_state_dict(state)

    def _in_units(self, z: Tensor) -> Tensor:
        """Return z in the units and the type of x0; rounding does not leave the bounds."""
        return (z * self._unit).to(self.dtype).clamp(*self._bounds)

    def _losses(self, values: Any, points: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return losses [K] and outputs [K, m] of what was told."""
        values = torch.as_tensor(values).detach().to(self._unit.device)
        if values.ndim < 1 or len(values) != len(points) or (self.loss is None and values.ndim != 1):
            wanted = f"[{len(points)}]" if self.loss is None else f"[{len(points)}, *out]"
            raise ValueError(f"values must have shape {wanted}, one per point asked for, got {list(values.shape)}")
        values = values.double()
        if self.loss is None:
            return values, None
        if self._search.shape and values.shape[1:] != self._search.shape:
            raise ValueError(
                f"values must have outputs {list(self._search.shape)} as before, got {list(values.shape[1:])}"
            )
        self._search.shape = values.shape[1:]
        with torch.no_grad():
            losses = [self.loss(one) for one in values]
        if not all(isinstance(one, Tensor) for one in losses):
            raise TypeError(f"loss must return a tensor, got {type(losses[0]).__name__}")
        if any(one.numel() != 1 for one in losses):
            raise ValueError(f"loss must return a scalar, got shape {list(losses[0].shape)}")
        return torch.stack([one.double().reshape(()) for one in losses]), values.flatten(1)


def _capacity(n: int, loss_alone: bool) -> int:
    """Evaluations to keep: twice what determines the model, within reason."""
    quadratic = min((n + 1) * (n + 2), 500) if loss_alone else 0
    return max(60, 6 * n, quadratic)


def _units(sigma: float | Tensor, x0: Tensor) -> Tensor:
    """Return sigma as float64 [n]."""
    unit = torch.as_tensor(sigma, dtype=torch.float64, device=x0.device).detach()
    if unit.shape not in ((), x0.shape) or not bool((torch.isfinite(unit) & (unit > 0)).all()):
        raise ValueError(f"sigma must be positive and finite, one value or one per parameter [{len(x0)}], got {sigma}")
    start = x0.detach()
    if bool((start + unit.to(x0.dtype) == start).any()):
        raise ValueError(f"sigma must be large enough to change x0 in {x0.dtype}, got {sigma} for {start}")
    return unit.expand_as(x0).clone()


def _box(bounds: tuple[float | Tensor, float | Tensor] | None, x0: Tensor) -> tuple[Tensor, Tensor]:
    """Return lower and upper [n], the outermost numbers within the bounds that the type of x0 has."""
    if bounds is None:
        infinite = torch.full_like(x0.detach(), math.inf)
        return -infinite, infinite
    if len(bounds) != 2:
        raise ValueError(f"bounds must be (lower, upper), got {len(bounds)} entries")
    lower, upper = (torch.as_tensor(one, dtype=torch.float64, device=x0.device).detach() for one in bounds)
    for name, one in (("lower", lower), ("upper", upper)):
        if one.shape not in ((), x0.shape):
            raise ValueError(f"the {name} bound must be a number or [{len(x0)}], got shape {list(one.shape)}")
    lower, upper = lower.expand_as(x0), upper.expand_as(x0)
    if not bool((lower < upper).all()):
        k = int((~(lower < upper)).nonzero()[0])
        raise ValueError(f"bounds must have lower < upper, got {float(lower[k])} and {float(upper[k])} at index {k}")
    start = x0.detach().double()
    if not bool(((start >= lower) & (start <= upper)).all()):
        k = int(((start < lower) | (start > upper)).nonzero()[0])
        raise ValueError(
            f"x0 must be within the bounds, got {float(start[k])} at index {k}, outside of "
            f"[{float(lower[k])}, {float(upper[k])}]"
        )
    inner = lower.to(x0.dtype), upper.to(x0.dtype)
    infinite = torch.full_like(inner[0], math.inf)
    return (
        torch.where(inner[0].double() < lower, inner[0].nextafter(infinite), inner[0]),
        torch.where(inner[1].double() > upper, inner[1].nextafter(-infinite), inner[1]),
    )
