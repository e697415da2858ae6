"""Minimise a black box by quadratic models of the smoothed function in a trust region tied to sigma: ask and tell."""

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.optim.local_model import LocalModel, fit_outputs, fit_values
from torch_zerohess.optim.pool import Pool
from torch_zerohess.optim.subproblem import ball_step, box_step

_FEW = 3
"""Parameters up to which a full quadratic of the loss takes so few evaluations that it leads, also with an output."""
_BATCH = 64
"""Points asked for at a time, at most."""
_WIDEST = 1.6
"""Largest sigma, in units of the first one."""
_FLAT = 0.03
"""Relative change of the loss below which a step has stayed on a plateau."""
_FAITHFUL = 0.25
"""Misfit of a predicted output up to which the model needs no new evaluations."""
_TOLERABLE = 5.0
"""Misfit up to which a step that lowers the loss is itself what the model needs to know."""
_MISLED = 2.0
"""Misfit beyond which other steps need more samples than the last time."""
_RETRIES = 2
"""Shorter steps tried in a row before samples are drawn."""
_STALLED = 8
"""Iterations after which the smoothed loss must have fallen by a twentieth, or sigma shrinks faster."""
_REFUSED = 10
"""Batches in a row with values that are not finite, after which the search ends."""

Phase = Literal["start", "sample", "trial"]

_STATE = (
    *("sigma", "evaluations", "iterations", "rounds", "done", "message"),
    *("_first", "_best", "_best_sigma", "_x", "_fx", "_lowest", "_local", "_local_value"),
    *("_phase", "_step", "_asked", "_need", "_paired", "_patience", "_refused"),
    *("_trust_output", "_faithful", "_reach", "_retries", "_misled"),
)
"""What changes as the search goes on, besides the models, the pool and the generator."""


class TrustRegion:
    """Second-order descent on a smoothed black box that counts evaluations. The caller evaluates.

    Each iteration fits a quadratic model of the smoothed loss to the pool of past evaluations (`Pool`, `fit_values`;
    `fit_outputs` if the black box returns a tensor and `loss` is given), minimises it within sigma sqrt(n) of x and
    within the bounds, and asks for that one point. New samples around x are asked for only where the model has
    predicted badly. Sigma, and with it the region, grows after a long good step and on a plateau, and shrinks after a
    short or refused one.

    - Loss alone, or n <= 3: the search descends, and moves to whatever evaluated point is best.
    - An output [K, *out] and a white-box `loss`: every evaluation is many equations. The search follows the minimum of
      loss(E f) while sigma goes to zero, also where the loss itself rises for a while.

    Where sigma has become small the search has arrived at a minimum, possibly a local one. It then starts again, in
    turn from a random point and around the best one, with more samples per iteration, up to `restarts` times.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: smoothing at the start, in units of the parameters: of the order of the distance to the solution.
            One value, or one per parameter [n] where they have different units.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        loss: from one output [*out] to a scalar, differentiable by torch; None if the black box returns the loss.
        restarts: how often to start again after arriving. 0 for a local search.
        tolerance: the search has arrived when sigma is below this times the first sigma.
        noise: standard deviation of repeated losses at one point, if it is known. Smaller decreases do not count.
        pool: evaluations kept; max(60, 6 n) if not given.
        seed: of the samples; from torch's global generator if None.

    Raises ValueError for settings out of range. Source: Wang, Fischer and Ritschel (2025) for the smoothed second
    order; evaluations are re-used as in derivative-free least squares (Cartis et al. 2019) and COBYQA.

    Example:
        >>> search = TrustRegion(torch.tensor([900.0, 850.0]), sigma=500.0, seed=0, restarts=0)
        >>> def quadratic(z):
        ...     return 5 * z[:, 0] ** 2 + 5 * z[:, 1] ** 2 + 7.5 * z[:, 0] * z[:, 1]
        >>> while search.evaluations < 9:
        ...     search.tell(quadratic(search.ask()))
        >>> search.value < 1e-3
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
        for name, value, lowest in (("restarts", restarts, 0), ("noise", noise, 0.0)):
            if not lowest <= value < math.inf:
                raise ValueError(f"{name} must be at least {lowest}, got {value}")
        if not 0.0 < tolerance < 1.0:
            raise ValueError(f"tolerance must be between 0 and 1, got {tolerance}")
        if pool is not None and pool < 4:
            raise ValueError(f"pool must be at least 4, got {pool}")
        self.n, self.dtype = len(x0), x0.dtype
        self.restarts, self.tolerance, self.noise, self.loss = restarts, tolerance, float(noise), loss
        # Everything below is in units of sigma: one sigma per parameter is a change of units.
        self._unit = _units(sigma, x0)
        start = x0.detach().double() / self._unit
        self._bounds = _box(bounds, x0)
        self._lower, self._upper = (one.double() / self._unit for one in self._bounds)
        self._pool = Pool(self.n, pool or max(60, 6 * self.n), x0.device)
        self._generator = torch.Generator()
        self._generator.manual_seed(int(torch.randint(2**63 - 1, ())) if seed is None else seed)
        self._first, self._best, self._x = start, start, start
        self._fx = self._lowest = self._local_value = math.inf
        self._local = start
        self._best_sigma = 1.0
        self.sigma = 1.0
        """Current smoothing, in units of the first one."""
        self.evaluations = 0
        """Values told so far."""
        self.iterations = 0
        self.rounds = 0
        """Times the search has arrived."""
        self.done = False
        self.message = ""
        """Why the search is done."""
        self._phase: Phase = "start"
        self._model: LocalModel | None = None
        self._output_model: LocalModel | None = None
        self._step = start
        self._asked: Tensor | None = None
        self._need, self._paired = 0, False
        self._patience = self._refused = 0
        self._trust_output = False
        self._faithful = False
        self._reach = 1.0
        self._retries = 0
        self._misled = 0
        self._followed: list[float] = []
        self._shape = torch.Size()

    # What the caller uses.

    @property
    def x(self) -> Tensor:
        """The best point so far [n]."""
        return self._in_units(self._best)

    @property
    def value(self) -> float:
        """The loss there; infinite before the first `tell`."""
        return self._lowest

    @property
    def center(self) -> Tensor:
        """Where the search is now [n], not always its best point."""
        return self._in_units(self._x)

    @property
    def unit(self) -> Tensor:
        """The first sigma per parameter [n]: what `sigma` and `LocalModel` are in units of."""
        return self._unit

    def model_at_best(self) -> tuple[LocalModel, float] | None:
        """A model around `x` and its sigma, that of when x was found or wider if few evaluations are near.

        None if the pool has lost touch with x, or before the first `tell`.
        """
        sigma = self._best_sigma
        for _ in range(8):
            weights = self._pool.weights(self._best, sigma)
            near = weights > 1e-3
            if int(near.sum()) > min(self.n, self._pool.capacity - 2):
                return self._fit((self._pool.points[near] - self._best) / sigma, near, weights[near]), sigma
            sigma *= 1.5
        return None

    def ask(self, limit: int | None = None) -> Tensor:
        """Return the next points to evaluate [K, n], at most `limit` of them; the same ones until they are told."""
        if limit is not None and limit < 1:
            raise ValueError(f"limit must be at least 1, got {limit}")
        if self.done:
            raise RuntimeError(f"the search is done: {self.message}")
        if self._asked is None:
            if self._phase == "trial":
                points = self._trial()[None]
            elif self._phase == "start":
                points = torch.cat([self._x[None], self._draw(min(self.n, _BATCH), paired=False)])
            else:
                points = self._draw(self._need, self._paired)
            self._asked = points
            if self.dtype != torch.float64:  # what is evaluated is the rounded point
                self._asked = self._in_units(points).double() / self._unit
        self._asked = self._asked[:limit]
        return self._in_units(self._asked)

    def tell(self, values: Any) -> None:
        """Take the values of the points that `ask` returned: [K], or [K, *out] if there is a `loss`.

        Values that are not finite are left out, and the step to such a point is refused and shortened. Raises
        ValueError for a wrong shape, or if the start itself has no finite value. The search is as before if this, or
        the loss, raises.
        """
        if self._asked is None:
            raise RuntimeError("ask for points before telling their values")
        before = self.state_dict()
        try:
            self._take(values, self._asked)
        except BaseException:
            self.load_state_dict(before)
            raise

    def state_dict(self) -> dict[str, Any]:
        """Everything that a search with the same settings needs to go on exactly as this one would.

        Tensors, numbers, strings, lists and dicts: `torch.save`, and `torch.load` with weights_only=True.
        """
        state = {name: getattr(self, name) for name in _STATE}
        return {
            **state,
            "n": self.n,
            "followed": list(self._followed),
            "shape": list(self._shape),
            "model": None if self._model is None else vars(self._model).copy(),
            "output_model": None if self._output_model is None else vars(self._output_model).copy(),
            "pool": self._pool.state_dict(),
            "generator": self._generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a `state_dict`; the settings and the loss stay those given here."""
        if state["n"] != self.n:
            raise ValueError(f"state must be of a search with {self.n} parameters, got one with {state['n']}")
        vars(self).update({name: state[name] for name in _STATE})
        self._followed, self._shape = list(state["followed"]), torch.Size(state["shape"])
        self._model, self._output_model = (
            None if state[name] is None else LocalModel(**state[name]) for name in ("model", "output_model")
        )
        self._pool.load_state_dict(state["pool"])
        self._generator.set_state(state["generator"].cpu())

    def _in_units(self, z: Tensor) -> Tensor:
        """Return z in the units and the type of x0; rounding does not leave the bounds."""
        return (z * self._unit).to(self.dtype).clamp(*self._bounds)

    def _take(self, values: Any, points: Tensor) -> None:
        """`tell` of the values of points [K, n]; may raise half-way."""
        self._asked = None
        losses, outputs = self._losses(values, points)
        finite = torch.isfinite(losses)
        if outputs is not None:
            finite &= torch.isfinite(outputs).all(1)
        if self.evaluations == 0 and not bool(finite[0]):
            raise ValueError(f"the black box is not finite at the start x0: {float(losses[0])}")
        self.evaluations += len(points)
        kept = None if outputs is None else outputs[finite]
        self._pool.add(points[finite], losses[finite], kept, self._x, self.sigma)
        self._remember(points[finite], losses[finite])
        self._refused = 0 if bool(finite.all()) else self._refused + 1
        if self._refused >= _REFUSED:
            self._finish(f"{_REFUSED} batches in a row had values that are not finite")
            return
        if self._phase == "trial":
            self.iterations += 1
            if bool(finite[0]):
                self._judge(points[0], float(losses[0]), None if outputs is None else outputs[0])
            else:
                self.sigma *= 0.5
                self._sample(2)
        else:
            if self._phase == "start":
                self._fx = float(losses[0]) if bool(finite[0]) else math.inf
            self._phase = "trial"
        if self.sigma < self.tolerance:
            self._arrive()
        if self._phase == "trial" and not self.done:
            self._plan()

    # Samples and steps.

    def _draw(self, count: int, paired: bool) -> Tensor:
        """Draw about `count` points from N(x, sigma^2), orthogonal in blocks, and mirror them into the bounds."""
        rows = self._directions((count + 1) // 2 if paired else count)
        u = torch.cat([rows, -rows]) if paired else rows
        z = self._x + self.sigma * u
        z = torch.where(z < self._lower, 2 * self._lower - z, z)
        z = torch.where(z > self._upper, 2 * self._upper - z, z)
        return z.clamp(self._lower, self._upper)

    def _directions(self, count: int) -> Tensor:
        """Normal vectors [count, n], orthogonal to each other and, in many dimensions, to what the pool spans."""
        n = self.n
        rows: list[Tensor] = []
        known = None
        if n > _BATCH and 1 < len(self._pool) < n:
            known, _ = torch.linalg.qr(((self._pool.points - self._x) / self.sigma).mT)
        while sum(len(one) for one in rows) < count:
            room = n if known is None else n - known.shape[1]
            block = self._normal(n, min(count, max(room, 1)))
            if known is not None:
                for _ in range(2):  # twice is enough (Kahan)
                    block = block - known @ (known.mT @ block)
            known = None
            directions, _ = torch.linalg.qr(block)
            rows.append(directions.mT * self._normal(directions.shape[1], n).norm(dim=1, keepdim=True))
        return torch.cat(rows)[:count]

    def _normal(self, *shape: int) -> Tensor:
        return torch.randn(*shape, generator=self._generator, dtype=torch.float64).to(self._x.device)

    def _plan(self) -> None:
        """Fit a model and find its step; where too few evaluations lie near, ask for more first."""
        weights = self._pool.weights(self._x, self.sigma)
        if self._faithful:  # the model is about to interpolate: what is nearest counts most
            distance = ((self._pool.points - self._x) / self.sigma).square().mean(1)
            weights = weights / (0.1 + distance).square()
        near = weights > 1e-3
        if int(near.sum()) < min(self.n, 4) + 1 and self._need == 0:
            self._sample(2)
            return
        self._need = 0
        u, weights = (self._pool.points[near] - self._x) / self.sigma, weights[near]
        self._model = self._fit(u, near, weights)
        outputs = self._pool.outputs
        if self.loss is not None and outputs is not None and self.n <= _FEW and not self._trust_output:
            self._output_model = fit_outputs(u, outputs[near], weights, self.loss, self._shape)
        radius = self._reach * math.sqrt(self.n)
        lower, upper = (self._lower - self._x) / self.sigma, (self._upper - self._x) / self.sigma
        if self._model.basis is None:
            self._step = box_step(self._model.gradient, self._model.hessian, radius, lower, upper)
        else:
            s = ball_step(self._model.gradient, self._model.hessian, radius)
            self._step = self._model.reduce(self._model.expand(s).clamp(lower, upper))

    def _fit(self, u: Tensor, near: Tensor, weights: Tensor) -> LocalModel:
        outputs = self._pool.outputs
        if self.loss is None or outputs is None:
            return fit_values(u, self._pool.values[near], weights)
        if self.n <= _FEW and not self._trust_output:
            return fit_values(u, self._pool.values[near], weights)
        return fit_outputs(u, outputs[near], weights, self.loss, self._shape)

    def _trial(self) -> Tensor:
        assert self._model is not None
        z = self._x + self.sigma * self._model.expand(self._step)
        return z.clamp(self._lower, self._upper)

    # What an evaluated step tells.

    def _judge(self, z: Tensor, fz: float, output: Tensor | None) -> None:
        """Take or refuse the step to z [n], adapt sigma, and decide on new samples."""
        assert self._model is not None
        length = float(self._step.norm()) / math.sqrt(self.n)
        if output is not None and self.n > _FEW:
            self._follow(z, fz, output, length)
            return
        if output is not None and self._output_model is not None:
            self._trust_output = self._output_model.misfit(self._output_model.reduce(self._u(z)), output) < _FAITHFUL
        self._descend(z, fz, length)

    def _descend(self, z: Tensor, fz: float, length: float) -> None:
        """Move to the best point of this round if it lowers the loss; else shrink, or grow on a plateau."""
        assert self._model is not None
        slack = 2.0 * self.noise
        promised = self._model.decrease(self._step)
        ratio = (self._fx - fz + slack) / (promised + slack) if promised + slack > 0.0 else -math.inf
        if min(fz, self._local_value) < self._fx - max(1e-3 * abs(self._fx), slack):
            self._patience = 0
            if fz <= self._local_value:
                if length > 0.9 and ratio > 0.5:
                    self.sigma *= 1.2
                elif length < 0.4:
                    self.sigma *= 0.75
            self._x, self._fx = (z, fz) if fz <= self._local_value else (self._local, self._local_value)
            if ratio > 0.7 and self._model.rank < self.n:
                self._sample(min(self.n - self._model.rank, _BATCH), paired=False)
            else:
                self._phase = "trial"
            return
        if self._model.significance < 0.0 and self._patience < 2:
            self._patience += self.sigma >= _WIDEST
            self.sigma = min(1.3 * self.sigma, _WIDEST)
        else:
            self.sigma *= 0.75
        self._sample(min(2**self.rounds, self.n))

    def _follow(self, z: Tensor, fz: float, output: Tensor, length: float) -> None:
        """Move with the minimum of the smoothed output's loss; the worse it was predicted, the more samples."""
        assert self._model is not None
        misfit, before = self._model.misfit(self._step, output), self._fx
        gain = before - fz
        if self._faithful and gain <= 0.0 and self._retries < _RETRIES:
            # The model was good so far: a shorter step, from a model that knows this point, is cheaper than samples.
            self._retries += 1
            self._reach = 0.4 * length
            self.sigma *= 0.9
            self._phase = "trial"
            return
        self._x, self._fx, self._retries, self._reach = z, fz, 0, 1.0
        if misfit < _TOLERABLE and gain > 0.02 * abs(before):
            self._faithful, self._misled = True, 0
            if misfit > _FAITHFUL:
                self.sigma *= _narrowing(length)
            self._phase = "trial"
            if misfit < _FAITHFUL and self._model.rank < self.n:
                self._sample(self.n - self._model.rank, paired=False)
            return
        self._faithful = misfit < _FAITHFUL and gain > 0.0
        self._misled = 0 if misfit < _FAITHFUL else self._misled + (misfit > _MISLED)
        narrow = _narrowing(length)
        self._followed.append(self._model.value)
        recent, earlier = self._followed[-_STALLED:], self._followed[:-_STALLED]
        if earlier and min(recent) > 0.95 * min(earlier):
            narrow *= 0.8
        if abs(gain) < _FLAT * abs(before) and misfit > _FAITHFUL and self._patience < 4:
            self._patience += 1
            if self._local_value < 0.9 * before:
                self._x, self._fx = self._local, self._local_value
            else:
                narrow = max(narrow, min(1.3, _WIDEST / self.sigma))
        self.sigma *= narrow
        most = 2 * math.ceil(self.n / 2)
        self._sample(min(2**self._misled, most) if misfit > _MISLED else 2 * math.ceil(self.n / 8))

    def _sample(self, count: int, *, paired: bool = True) -> None:
        self._phase, self._need = "sample", min(count, _BATCH)
        self._paired = paired and count > 1

    def _arrive(self) -> None:
        """End, or start another round."""
        self.rounds += 1
        if self.rounds > self.restarts:
            self._finish(f"sigma fell below {self.tolerance} of the first one, {self.rounds} times")
            return
        self.sigma = 1.5
        self._x = self._best
        if self.rounds % 2:
            bounded = bool(torch.isfinite(self._lower).all() and torch.isfinite(self._upper).all())
            if bounded:
                uniform = torch.rand(self.n, generator=self._generator, dtype=torch.float64).to(self._x.device)
                self._x = self._lower + (self._upper - self._lower) * uniform
            else:
                self._x = (self._first + 2.0 * self._normal(self.n)).clamp(self._lower, self._upper)
        self._local_value, self._patience, self._followed, self._phase = math.inf, 0, [], "start"

    def _finish(self, message: str) -> None:
        self.done, self.message = True, message

    def _remember(self, points: Tensor, losses: Tensor) -> None:
        if not len(losses):
            return
        k = int(losses.argmin())
        value = float(losses[k])
        if value < self._local_value:
            self._local, self._local_value = points[k], value
        if value < self._lowest:
            self._best, self._lowest, self._best_sigma = points[k], value, self.sigma

    def _u(self, z: Tensor) -> Tensor:
        return (z - self._x) / self.sigma

    def _losses(self, values: Any, points: Tensor) -> tuple[Tensor, Tensor | None]:
        """Return losses [K] and outputs [K, m] of what was told."""
        values = torch.as_tensor(values).detach().to(self._x.device)
        if values.ndim < 1 or len(values) != len(points) or (self.loss is None and values.ndim != 1):
            wanted = f"[{len(points)}]" if self.loss is None else f"[{len(points)}, *out]"
            raise ValueError(f"values must have shape {wanted}, one per point asked for, got {list(values.shape)}")
        values = values.double()
        if self.loss is None:
            return values, None
        if self._shape and values.shape[1:] != self._shape:
            raise ValueError(f"values must have outputs {list(self._shape)} as before, got {list(values.shape[1:])}")
        self._shape = values.shape[1:]
        losses = [self.loss(one) for one in values]
        if any(one.numel() != 1 for one in losses):
            raise ValueError(f"loss must return a scalar, got shape {list(losses[0].shape)}")
        return torch.stack([one.detach().double().reshape(()) for one in losses]), values.flatten(1)


def _narrowing(length: float) -> float:
    """Factor for sigma after a step of a length in units of the radius: short steps have found the minimum."""
    return min(max(0.85 + 0.3 * length, 0.8), 1.05)


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
    lower, upper = (torch.as_tensor(one, dtype=torch.float64, device=x0.device) for one in bounds)
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
