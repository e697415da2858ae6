"""The first term of a control variate: c E h(g(x + sigma u), r), the smoothed surrogate, which takes no evaluations.

The expectation is a mean over points x + sigma u. Its derivatives are either

    pathwise   derivatives of h and g along the points; h and g must be smooth,
    Stein      mean of h(g(x + sigma u), r) times the kernels of u, as for the black box itself; h and g may be rough.

Where h is smooth both are unbiased. Derivatives of a surrogate that follows hard edges vary fast within a sigma: there
Stein's sums have the smaller variance. Their error grows with the number of parameters, the pathwise one does not.
`prefers_pathwise` measures both.

The points u are a Sobol sequence with a random shift (Cranley and Patterson 1976), mapped to the normal distribution,
and their mirror images: the mean is unbiased, and its error falls faster than the error of independent draws.
"""

import copy
import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.control import Control, Prediction, as_constant
from torch_zerohess.estimation.stein import Quantity

_SOBOL = 64
"""Parameters up to which points are quasi-random; beyond them a sequence of few points is not even."""
MOST_STEIN = 8
"""Parameters up to which Stein's sums are tried."""
_POINTS = 1024
"""Points of a call with few parameters, shared by the elements of its batch."""
_FEWEST = 64
"""Points per element at least."""
_FEW = 32
"""Parameters that are few."""
_PAIRS = 2
"""Pairs of points per element with many parameters, of which the surrogate is affine. Derivatives of a loss that is
quadratic in an affine map are exact from one pair, and two pairs tell an error."""
_TRIED = 4
"""Elements of a batch on which both derivatives are compared."""
LOOKED = 512
"""Points around the elements of a batch at which a surrogate is looked at for jumps, at most."""
_EDGE = 1e-9
"""Probability at which the normal quantile is cut off."""


@functools.lru_cache(maxsize=32)
def _even(count: int, n: int) -> Tensor:
    return torch.quasirandom.SobolEngine(n, scramble=True, seed=0).draw(count, dtype=torch.float64)


def nodes(seed: int, count: int | None, n: int, batch: int) -> Tensor:
    """Return normal points [2 * ceil(count / 2), n] float64: the second half mirrors the first.

    Without a count they are 4 for more than 32 parameters, otherwise 1024 / batch and at least 64.
    """
    if count is None:
        count = max(_POINTS // max(batch, 1), _FEWEST) if n <= _FEW else 2 * _PAIRS
    half = (count + 1) // 2
    generator = torch.Generator().manual_seed(seed)
    if n > _SOBOL:
        u = torch.randn(half, n, generator=generator, dtype=torch.float64, device="cpu")
    else:
        shifted = (_even(half, n) + torch.rand(n, generator=generator, dtype=torch.float64, device="cpu")) % 1.0
        u = torch.special.ndtri(shifted.clamp(_EDGE, 1.0 - _EDGE))
    return torch.cat([u, -u])


def smoothed(
    values: Callable[[Tensor], Tensor], x: Tensor, center: Tensor, sigma: Tensor, u: Tensor, *, pathwise: bool
) -> Tensor:
    """Return the mean of values around x [B, n], [B, *out], in the dtype of x, with derivatives in x of every order.

    Args:
        values: [B, Q, n] -> [B, Q, *out].
        x: [B, n], with a graph.
        center: [B, n], where the points of Stein's sums are drawn.
        sigma: float64 [n].
        u: [Q, n], see `nodes`.
        pathwise: derivatives along the points, not by Stein's sums.
    """
    if pathwise:
        return values((x[:, None] + sigma * u).to(x.dtype)).mean(1).to(x.dtype)
    with torch.no_grad():
        fixed = values((center[:, None] + sigma * u).to(center.dtype)).double()
        change = fixed - values(center[:, None]).double()  # of no influence on the expectation of the derivatives
    mean, change = fixed.mean(1), change.reshape(*change.shape[:2], -1)
    d = (x.double() - center.double()) / sigma
    ratio = (d @ u.mT - 0.5 * (d * d).sum(1, keepdim=True)).exp()
    moved = ((ratio - 1.0)[:, None] @ change)[:, 0] / len(u)
    return (mean + moved.reshape(mean.shape)).to(x.dtype)


@dataclass(frozen=True)
class SurrogateTerm:
    """The term at points x [B, n] with auxiliary inputs [B, ...], and its derivatives without autograd.

    Quantities are [B, P] for P outputs, [B, P, n] where they are derivatives, and [B, P, n, n] for the "hessian".
    """

    surrogate: Any
    control: Control
    x: Tensor
    aux: Sequence[Tensor]
    sigma: Tensor
    """float64 [n]"""
    u: Tensor
    """[Q, n], see `nodes`."""
    pathwise: bool
    _predicted: Prediction = field(init=False)

    def __post_init__(self) -> None:
        # Before any transform of torch.func begins: what is computed inside of one cannot be used after it.
        object.__setattr__(self, "_predicted", Prediction(self.control, self.surrogate, self.aux))

    @classmethod
    def fixed(
        cls, control: Control, x: Tensor, aux: Sequence[Tensor], sigma: Tensor, seed: int, order: int
    ) -> "SurrogateTerm":
        """Return the term with copies of the surrogate and of aux: a later fit or training does not change it."""
        memory = control.memory
        u = nodes(seed, memory.draws, x.shape[1], len(x)).to(x.device)
        if memory.pathwise is None:
            memory.pathwise = prefers_pathwise(control, x, aux, sigma, u, order)
        copies = [one.clone() for one in aux]
        return cls(copy.deepcopy(memory.surrogate), control, x, copies, sigma, u, bool(memory.pathwise))

    @property
    def encoded(self) -> list[Tensor]:
        """What `Prediction` made of aux."""
        return self._predicted.encoded

    def mean(self, quantity: Quantity, v: Tensor | None = None) -> Tensor:
        """Return a quantity; v is the direction [B, n] of the "hvp"."""
        return self.hessian() if quantity == "hessian" else self._pairs(quantity, v).mean(1)

    def variance(self, quantity: Quantity, v: Tensor | None = None) -> Tensor:
        """Return the variance of `mean`, from the spread of the pairs as if independent: usually too large."""
        if quantity == "hessian":
            return torch.stack([self.variance("hvp", unit.expand_as(self.x)) for unit in self._units], 3)
        pairs = self._pairs(quantity, v)
        return pairs.var(1) / pairs.shape[1]

    def spread(self, error: Tensor, degrees: Tensor, quantity: Quantity, v: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the standard error of the term plus an independent estimate, and its degrees of freedom.

        Args:
            error: standard error of the independent estimate.
            degrees: its degrees of freedom; the degrees of freedom of the sum are by Satterthwaite.
            quantity: which.
            v: [B, n], the vector of the "hvp".
        """
        own = len(self.u) // 2 - 1
        mine = self.variance(quantity, v).sqrt()
        whole = torch.hypot(error, mine)
        unit = torch.where(whole > 0, whole, 1.0)
        inverse = (error / unit) ** 4 / degrees + (mine / unit) ** 4 / own
        return whole, torch.where(whole > 0, 1.0 / inverse, degrees)

    def hessian(self) -> Tensor:
        """Return the Hessian [B, P, n, n]."""
        columns = [self.mean("hvp", unit.expand_as(self.x)) for unit in self._units]
        result = torch.stack(columns, 3)
        return 0.5 * (result + result.mT)

    def _each(self, x: Tensor) -> Tensor:
        """Return c h(g(x + sigma u), r) at every point, [B, Q, P]."""
        z = (x[:, None] + self.sigma * self.u).to(self.x.dtype)
        values = self.control.coefficient * self._predicted(z)
        return values.reshape(*values.shape[:2], -1).double()

    def _pairs(self, quantity: Quantity, v: Tensor | None) -> Tensor:
        """Return a quantity for every pair of mirrored points: [B, Q / 2, P], or [B, Q / 2, P, n]."""
        if quantity == "value" or not self.pathwise:
            with torch.no_grad():
                each = self._by_stein(quantity, v)
        else:
            each = self._along_points(quantity, v)
        each, half = each.detach(), len(self.u) // 2  # a module has parameters that require grad
        return 0.5 * (each[:, :half] + each[:, half:])

    def _by_stein(self, quantity: Quantity, v: Tensor | None) -> Tensor:
        values, u = self._each(self.x.double()), self.u[:, None]
        if quantity == "value":
            return values
        center = self._predicted(self.x[:, None]).double()
        change = (values - self.control.coefficient * center.reshape(len(values), 1, -1))[..., None]
        if quantity == "gradient":
            return change * u / self.sigma
        if quantity == "hessian_diagonal":
            return change * (u * u - 1.0) / self.sigma**2
        assert v is not None
        t = (v.double() / self.sigma)[:, None, None]
        return change * (u * (u * t).sum(-1, keepdim=True) - t) / self.sigma

    def _along_points(self, quantity: Quantity, v: Tensor | None) -> Tensor:
        x = self.x.double()
        if quantity == "gradient":
            return torch.stack([self._along(x, one) for one in self._units], 3)
        directions = self._units if v is None else [v.to(x)] * x.shape[1]
        parts = [
            _derivative(functools.partial(self._along, v=one), x, other.expand_as(x))
            for one, other in zip(self._units, directions, strict=True)
        ]
        return torch.stack(parts, 3)

    def _along(self, x: Tensor, v: Tensor) -> Tensor:
        return _derivative(self._each, x, v.expand_as(x))

    @property
    def _units(self) -> list[Tensor]:
        return list(torch.eye(len(self.sigma), dtype=torch.float64, device=self.x.device))


def _derivative(fn: Callable[[Tensor], Tensor], x: Tensor, v: Tensor) -> Tensor:
    """Return the derivative of fn at x along v by forward mode."""
    with warnings.catch_warnings():  # forward mode of torch warns about itself when it is first used
        warnings.filterwarnings("ignore", "`torch.jit.script", FutureWarning)
        result: Tensor = torch.func.jvp(fn, (x,), (v,))[1]
    return result


def prefers_pathwise(
    control: Control, x: Tensor, aux: Sequence[Tensor], sigma: Tensor, u: Tensor, order: int
) -> bool | None:
    """Whether pathwise derivatives of the surrogate at x [B, n] vary less than Stein's sums.

    Both are computed for a few elements of the batch, and the variances of the derivative of this order compared. The
    answer depends on the surrogate and not on evaluations of the present call. The pathwise derivatives of a table, a
    tree or a model outside of autograd are 0, without variance, and wrong: the answer is no. It is None where the
    surrogate is constant wherever it was looked at: both derivatives are 0 there, and another call decides.
    """
    surrogate, step = control.memory.surrogate, -(-len(x) * len(u) // LOOKED)
    found = jumps(surrogate, (x[:, None] + sigma * u).flatten(0, 1)[::step].to(x.dtype))
    if found is not False:
        return None if found is None else False
    if len(sigma) > MOST_STEIN:
        return True
    few = SurrogateTerm(surrogate, control, x[:_TRIED], [one[:_TRIED] for one in aux], sigma, u, True)
    quantity: Quantity = "gradient" if order == 1 else "hessian_diagonal"
    return float(few.variance(quantity).sum()) < float(replace(few, pathwise=False).variance(quantity).sum())


def jumps(surrogate: Callable[[Tensor], Tensor], z: Tensor) -> bool | None:
    """Whether outputs at points z [Q, n] differ where their derivative says that they are constant; None if they do not
    differ.
    """
    with torch.inference_mode(False), torch.enable_grad():
        at = z.clone().requires_grad_()
        outputs = as_constant(surrogate, at).reshape(len(z), -1)
        if bool((outputs == outputs[:1]).all()):
            return None
        if not outputs.requires_grad:
            return True
        weights = torch.arange(
            1, 1 + outputs.shape[1], dtype=outputs.dtype, device=outputs.device
        )  # their plain sum may be constant
        (slope,) = torch.autograd.grad((outputs @ weights).sum(), at, allow_unused=True)
    return slope is None or not bool(slope.any())
