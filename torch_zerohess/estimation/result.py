"""The result of an estimate: the value and derivatives, and the error of each."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, get_args

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_number
from torch_zerohess.estimation.call import ValueMode
from torch_zerohess.estimation.inputs import NO_GRAPH, all_finite, attribute, check_no_derivative, short
from torch_zerohess.estimation.skewness import Shape, extension
from torch_zerohess.estimation.stein import Quantity
from torch_zerohess.estimation.student import student_factor
from torch_zerohess.estimation.sums import Sums, combined, combined_spread
from torch_zerohess.estimation.surrogate_term import SurrogateTerm
from torch_zerohess.wrappers import readable

_MOST_LEVEL = 0.9999  # up to which the factor of Student's t is right to four digits


class ConfidenceInterval(NamedTuple):
    """Ends of an interval, each in the shape of the estimate."""

    low: Tensor
    high: Tensor


class Estimate:
    """Estimates of F(x) = E f(x + sigma u) and its derivatives, all from the same samples (Stein's identities).

    `value` and `gradient` are attributes. Second derivatives are methods, formed when asked for: `hvp(v)`,
    `hessian_diagonal()`, `hessian()`. Standard errors and intervals are of F and its derivatives. `value` is f(x) and
    has none, unless `value="smoothed"` was asked for; the printed estimate says which of the two it is. Shapes, for x
    [*batch, n] and a black box with output [*out]: see each of them. Made by `estimate`.

    All but `evaluations` and `dropped` raise ValueError where a result does not exist in the dtype of x.
    """

    reason: str
    """Which limit ended the drawing: of `estimate` with a tolerance."""

    def __init__(
        self,
        batches: Sequence[Sums],
        batch: torch.Size,
        x: Tensor,
        *,
        reason: str,
        value: ValueMode = "center",
        term: SurrogateTerm | None = None,
        chosen: str = "",
        joint: bool = False,
    ) -> None:
        self._batches, self._batch, self._x, self.reason = batches, batch, x, reason
        self._value_mode, self._term, self._chosen, self._joint = value, term, chosen, joint
        self._made: dict[str, Tensor] = {}
        expansion = batches[0].evaluations.expansion
        self._sigma, self._out = expansion.sigma, expansion.base.shape[1:]

    @property
    def value(self) -> Tensor:
        """f(x), or the estimate of F(x) where `value="smoothed"` was asked for: [*batch, *out]."""
        B, P = self._batch.numel(), self._out.numel()
        base = combined(self._batches, lambda one: one.evaluations.expansion.base.reshape(B, P))
        smoothed = self._value_mode == "smoothed"
        return self._shaped(self._completed(base, "value") if smoothed else base, "value")

    @property
    def gradient(self) -> Tensor:
        """dF/dx_i: [*batch, *out, n]."""
        return self._once("gradient", lambda: self._shaped(self._unrounded_gradient(), "gradient"))

    def _unrounded_gradient(self) -> Tensor:
        """dF/dx_i in float64, [B, P, n]."""
        mean = combined(self._batches, lambda one: one.stein.scaled_gradient(one.a, self._sigma))
        return self._completed(mean, "gradient")

    def hvp(self, v: Tensor) -> Tensor:
        """Hessian of F times v [*batch, n] or [n]: [*batch, *out, n], O(K n) without the Hessian."""
        v = self._vector(v)
        mean = combined(self._batches, lambda one: one.stein.scaled_hvp(one.a, v, self._sigma))
        return self._shaped(self._completed(mean, "hvp", v), "hvp")

    def hessian_diagonal(self) -> Tensor:
        """d2F/dx_i2: [*batch, *out, n], O(K n) without the Hessian."""
        sums = combined(self._batches, lambda one: one.stein.hessian_diagonal(one.a))
        sums = self._completed(self._in_units(sums, "hessian_diagonal"), "hessian_diagonal")
        return self._shaped(sums, "hessian_diagonal")

    def hessian(self) -> Tensor:
        """d2F/dx_i dx_j: [*batch, *out, n, n], symmetric; formed at every call.

        Raises MemoryError where there is no memory for it.
        """
        try:
            return self._hessian()
        except RuntimeError as error:
            if "allocate" not in str(error):
                raise
            shape = [*self._batch, *self._out, len(self._sigma), len(self._sigma)]
            raise MemoryError(f"there is no memory for a Hessian {shape}: use hvp or hessian_diagonal") from error

    def _hessian(self) -> Tensor:
        one = float(self._sigma[0])
        if bool((self._sigma == one).all()):  # divide the coefficients: they are few, and a Hessian is large
            sums = combined(self._batches, lambda batch: batch.stein.hessian(batch.a / one / one))
        else:
            sums = self._in_units(combined(self._batches, lambda batch: batch.stein.hessian(batch.a)), "hessian")
        return self._shaped(self._completed(sums, "hessian"), "hessian")

    def standard_error(self, quantity: Quantity, v: Tensor | None = None) -> Tensor:
        """Standard error of an estimate, in the shape of the estimate, from the spread of its independent draws.

        An antithetic pair is one draw. So are a whole scramble of sampler "sobol" and a block of "orthogonal". Few
        draws give a poor estimate of their spread: for an interval take `confidence_interval`, not a fixed number of
        standard errors. With baseline "mean" the draws depend on each other, and the error is by the jackknife.

        Args:
            quantity: "value" (of F(x), also where `value` is f(x)), "gradient", "hessian_diagonal", "hessian" or "hvp".
            v: the vector of the "hvp", [*batch, n] or [n].

        Raises:
            ValueError: fewer than two independent draws (three with baseline "mean"), an unknown quantity, or an "hvp"
                without v.
        """
        error, _, _ = self._spread(quantity, self._checked(quantity, v))
        return self._shaped(error, f"standard error of the {quantity}")

    def confidence_interval(
        self, quantity: Quantity, v: Tensor | None = None, *, level: float = 0.95
    ) -> ConfidenceInterval:
        """Interval that contains a quantity of F with a probability of `level`.

        It reaches t standard errors below and above the estimate, and further on the side to which draws are skewed. t
        is the quantile of Student's distribution, with one degree of freedom less than independent draws: at 95 % 12.7
        for two draws (sampler "sobol" has two below 32 samples), 3.2 for four, 2.1 for 16, 1.96 for many. For "optimal"
        the draws are the samples of an element.

        A draw is a kernel times f. Draws are nearly normal if f varies at random or in waves: the interval is right
        within four points from four draws up. Draws are skewed, many small ones and a few large ones, if the curvature
        of f has one sign, and more so the wider the tails of the kernel ("gaussian" more than "aggregate" and
        "optimal", the Hessian more than the gradient). With "gaussian" the draws of the gradient of a linear f are
        skewed, too: they are squares. Where few large draws were met, the estimate and its standard error are both too
        small. From four draws up the interval therefore reaches up to three times as far on that side, see `skewness`.
        Few draws seldom meet large ones, and do not tell that there are any. Of 2 000 intervals of 95 % for exp(x_1 +
        x_2) with sigma 0.3 and random antithetic pairs these shares contain the truth, the lowest of all entries:

        | proposal | draws | value | gradient | Hessian |
        |---|---|---|---|---|
        | aggregate | 4, 16, 64 | 0.92, 0.96, 0.95 | 0.92, 0.95, 0.95 | 0.68, 0.87, 0.94 |
        | gaussian | 4, 16, 64 | 0.86, 0.93, 0.97 | 0.85, 0.92, 0.96 | 0.58, 0.76, 0.89 |
        | optimal | 4, 16, 64 | 0.85, 0.93, 0.96 | 0.96, 0.96, 0.96 | 0.87, 0.94, 0.96 |

        Intervals of 68 % cover 0.48, 0.59 and 0.64 of the Hessian ("aggregate"): they are hardly extended. With sigma
        1, where the function grows 55 times from -2 to 2 sigma along each axis, 64 draws cover 0.90 at 95 %. All
        samplers and baselines are counted by `python -m experiments stability`. On waves four draws with baseline
        "mean" cover 0.85 at 68 %. With a memory a draw is a kernel times f - g. If the surrogate g is good, f - g is
        small but for a few points far out. Few draws seldom meet them, and intervals of the Hessian are too short then,
        although its error is far smaller than without a memory.

        Args:
            quantity: as for `standard_error`; "value" is F(x), also where `value` is f(x).
            v: the vector of the "hvp", [*batch, n] or [n].
            level: between 0 and 0.9999.

        Returns:
            low and high, each in the shape of the estimate.

        Raises:
            ValueError: as `standard_error`, or a level out of its range.
        """
        level = checked_number("level", level, above=0.0, most=_MOST_LEVEL)
        v = self._checked(quantity, v)
        error, degrees, form = self._spread(quantity, v)
        t = student_factor(level, degrees)
        further = extension(form, t)
        if quantity == "value":
            middle = combined(self._batches, lambda one: one.evaluations.smoothed.reshape(error.shape))
        else:
            w = self._in_sigma(v)
            middle = self._in_units(combined(self._batches, lambda one: one.stein.sums(quantity, one.a, w)), quantity)
        middle = self._completed(middle, quantity, v)
        ends = middle - error * (t - further.clamp_max(0.0)), middle + error * (t + further.clamp_min(0.0))
        return ConfidenceInterval(*(self._shaped(one, f"interval of the {quantity}") for one in ends))

    @property
    def evaluations(self) -> int:
        """How often the black box was evaluated, f(x) included; a joint evaluation counts once."""
        found = [one.evaluations for one in self._batches]
        each = sum(one.K + (one.center is not None) for one in found)
        return each if self._joint else each * self._batch.numel()

    @property
    def points(self) -> Tensor:
        """Every point that was evaluated, [*batch, K, n]; x itself is the last one where f(x) was evaluated."""
        return self._once("points", self._points)

    def _points(self) -> Tensor:
        x = self._x.reshape(-1, 1, len(self._sigma))
        centers = [x for one in self._batches if one.evaluations.center is not None]
        points = torch.cat([one.evaluations.points for one in self._batches] + centers, 1)
        return points.reshape((*self._batch, *points.shape[1:]))

    @property
    def values(self) -> Tensor:
        """Values at `points`, [*batch, K, *out]."""
        return self._once("values", self._values)

    def _values(self) -> Tensor:
        found = [one.evaluations for one in self._batches]
        centers = [one.center[:, None] for one in found if one.center is not None]
        values = torch.cat([one.values for one in found] + centers, 1)
        return values.reshape((*self._batch, *values.shape[1:]))

    @property
    def dropped(self) -> int:
        """Evaluations left out by on_nonfinite="drop". Of an antithetic pair both are left out."""
        return sum(one.evaluations.dropped for one in self._batches)

    def __repr__(self) -> str:
        shape = f"x {list(self._x.shape)}, output {[*self._batch, *self._out]}"
        of = "F" if self._value_mode == "smoothed" else "f"
        parts = [shape, f"{attribute(self, 'value')} ({of}(x))", attribute(self, "gradient")]
        parts += [f"auto: {self._chosen}"] * bool(self._chosen)
        parts += [f"evaluations={self.evaluations}"] + [f"dropped={self.dropped}"] * (self.dropped > 0)
        return f"Estimate({', '.join(parts)})"

    def _once(self, name: str, make: Callable[[], Tensor]) -> Tensor:
        """Make a tensor once. What a transform of torch or inference mode makes is not kept: it serves nothing else."""
        result = self._made[name] if name in self._made else make()
        if readable(result) and not result.is_inference():
            self._made[name] = result
        return result

    def _spread(self, quantity: Quantity, v: Tensor | None) -> tuple[Tensor, Tensor, Shape]:
        """Return the standard error in units of x, its degrees of freedom and its shape; v as from `_vector`."""
        own, degrees, form = combined_spread(self._batches, quantity, self._in_sigma(v))
        own = self._in_units(own, quantity)
        if self._term is None:
            return own, degrees, form
        error, degrees = self._term.spread(own, degrees, quantity, None if v is None else v[:, 0])
        return error, degrees, form.scaled(own / torch.where(error > 0, error, 1.0))

    def _completed(self, rest: Tensor, quantity: Quantity, v: Tensor | None = None) -> Tensor:
        """Add what the surrogate of a memory explains; v as from `_vector`."""
        if self._term is None:
            return rest
        return rest + self._term.mean(quantity, None if v is None else v[:, 0])

    def _in_sigma(self, v: Tensor | None) -> Tensor | None:
        """Return the vector of an hvp in units of sigma."""
        return None if v is None else v / self._sigma

    def _in_units(self, sums: Tensor, quantity: Quantity) -> Tensor:
        """Sums in units of x; one division after another, because the square of a small sigma is zero."""
        if quantity == "value":
            return sums
        if quantity == "hessian":
            one = self._batches[0].evaluations.smoothing.sigma
            if isinstance(one, float):  # in place: a Hessian is large, and the sums are of no other use
                return sums.div_(one).div_(one)
            i, j = self._sigma[:, None], self._sigma  # the larger sigma first, for symmetry to the last bit
            return sums / torch.maximum(i, j) / torch.minimum(i, j)
        return sums / self._sigma / self._sigma if quantity == "hessian_diagonal" else sums / self._sigma

    def _shaped(self, flat: Tensor, what: str) -> Tensor:
        """Return [B, P, ...] as [*batch, *out, ...] in the dtype of x; ValueError if it is not finite there."""
        result = flat.reshape(self._batch + self._out + flat.shape[2:])
        result = result if result.dtype == self._x.dtype else result.to(self._x.dtype)
        if not all_finite(result):
            largest = max(float(one.evaluations.values.abs().max()) for one in self._batches)
            raise ValueError(
                f"the {what} is not finite in {self._x.dtype}: sigma is {float(self._sigma.min()):g} at least and "
                f"{float(self._sigma.max()):g} at most, and fn returned up to {largest:.3g}; scale x and sigma, or "
                "what fn returns"
            )
        return result

    def _checked(self, quantity: Quantity, v: Tensor | None) -> Tensor | None:
        if quantity not in get_args(Quantity):
            *others, last = map(repr, get_args(Quantity))
            raise ValueError(f"quantity must be {', '.join(others)} or {last}, got {quantity!r}")
        if (quantity == "hvp") != (v is not None):
            raise ValueError("v is the vector of quantity 'hvp': give it there and only there")
        return None if v is None else self._vector(v)

    def _vector(self, v: Tensor) -> Tensor:
        """Return v as float64 [B, P, n]; ValueError if it has another shape or is not finite."""
        (n,) = self._sigma.shape
        if not isinstance(v, Tensor) or v.shape not in ((n,), (*self._batch, n)):
            given = list(v.shape) if isinstance(v, Tensor) else type(v).__name__
            wanted = " or ".join(map(str, dict.fromkeys((f"[{n}]", f"{[*self._batch, n]}"))))
            raise ValueError(f"v must be a tensor of shape {wanted}, got {given}")
        check_no_derivative(NO_GRAPH, v=v)
        if not all_finite(v):
            raise ValueError(f"v must be finite, got {short(v)}")
        v = v.detach().to(self._sigma)
        v = v if v.dim() == 1 else v.reshape(-1, 1, n)
        return v.expand(self._batch.numel(), self._out.numel(), n).contiguous()
