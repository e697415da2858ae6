"""The first term of a control variate: c E h(g(x + sigma u), r), the smoothed surrogate, which takes no evaluations.

Where h and g are smooth, its derivatives may be pathwise or by Stein's sums, see `surrogate_mean`: both are unbiased.
With kinks, as of an absolute error, slopes are pathwise and second derivatives are not. With jumps no derivative is.
`smoothness` tells. Derivatives of a surrogate that follows hard edges vary fast within a sigma: there Stein's sums have
the smaller variance. Their error grows with the number of parameters, the pathwise one does not. `measure` compares.

Where a head goes through large outputs, second derivatives along the points take long, and slopes do not. Then Stein's
sums of the slopes are compared, too.
"""

import copy
import functools
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.control import Control, Prediction, in_coordinates
from torch_zerohess.estimation.smoothness import check_repeats, jumps, known_smooth, smooth_orders
from torch_zerohess.estimation.stein import Quantity
from torch_zerohess.estimation.surrogate_mean import nodes, per_element
from torch_zerohess.precision import without_autocast
from torch_zerohess.surrogates.surrogate import outside_inference

MOST_STEIN = 8
"""Parameters up to which Stein's sums are tried."""
_TRIED = 4
"""Elements of a batch on which both derivatives are compared."""
_SUMS = 4
"""Sums of all outputs with random signs, on which both derivatives are compared. The variance of such a sum has the sum
of the variances of the outputs as its mean."""
_REPEATS = 8
"""Means over other points, which measure the variance of one."""
_TRIED_POINTS = 16
"""Points of each of them, if a point is costly."""
_SHORTER = 4
"""Points of the term per point at which a surrogate is looked at for jumps and kinks once more, at least."""
_LOOKED = 512
"""Points around the elements of a batch at which a surrogate is looked at for jumps, at most."""


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
    """[B, Q, n], see `nodes`."""
    pathwise: int
    """Orders of derivatives along the points."""
    seed: int
    """Of the points of other means, see `variance`."""
    sums: int | None = None
    """How many sums of all outputs with random signs take the place of more outputs than these; None: none."""
    _predicted: Prediction = field(init=False)

    def __post_init__(self) -> None:
        # Before any transform of torch.func begins: what is computed inside of one cannot be used after it.
        object.__setattr__(self, "_predicted", Prediction(self.control, self.surrogate, self.aux))

    @classmethod
    def fixed(
        cls, control: Control, x: Tensor, aux: Sequence[Tensor], sigma: Tensor, seed: int, order: int
    ) -> "SurrogateTerm":
        """Return the term with copies of the surrogate and of aux: a later fit or training does not change it."""
        memory, (B, n) = control.memory, x.shape
        measure(control, x, aux, sigma, order, seed)
        pathwise = memory.pathwise or 0
        u = nodes(seed, point_count(control, B, n, pathwise), n, B).to(x.device)
        with outside_inference():
            copies = [one.clone() for one in aux]
            return cls(copy.deepcopy(memory.surrogate), control, x.clone(), copies, sigma, u, pathwise, seed)

    @property
    def encoded(self) -> list[Tensor]:
        """What `Prediction` made of aux."""
        return self._predicted.encoded

    def mean(self, quantity: Quantity, v: Tensor | None = None) -> Tensor:
        """Return a quantity; v is the direction [B, n] of the "hvp"."""
        return self.hessian() if quantity == "hessian" else self._pairs(quantity, v).mean(1)

    def variance(self, quantity: Quantity, v: Tensor | None = None) -> Tensor:
        """Return the variance of `mean`, from means over other points: the points of one mean are not independent."""
        B, count, n = self.u.shape
        seeds = torch.Generator().manual_seed(self.seed)
        means = []
        for _ in range(_REPEATS):
            seed = int(torch.randint(2**62, (), generator=seeds, device="cpu"))
            u = nodes(seed, count, n, B).to(self.u.device)
            means.append(replace(self, u=u).mean(quantity, v))
        return torch.stack(means).var(0)

    def variance_of_pairs(self, quantity: Quantity) -> Tensor:
        """Return the variance of `mean` as if its pairs were independent: usually too large."""
        pairs = self._pairs(quantity, None)
        return pairs.var(1) / pairs.shape[1]

    def spread(self, error: Tensor, degrees: Tensor, quantity: Quantity, v: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the standard error of the term plus an independent estimate, and its degrees of freedom.

        Args:
            error: standard error of the independent estimate.
            degrees: its degrees of freedom; the degrees of freedom of the sum are by Satterthwaite.
            quantity: which.
            v: [B, n], the vector of the "hvp".
        """
        own = _REPEATS - 1
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
        return self._numbers(self.control.coefficient * self._predicted(z)).double()

    def _numbers(self, values: Tensor) -> Tensor:
        """Return values [B, Q, *out] as [B, Q, P], or their `sums`."""
        values = values.reshape(*values.shape[:2], -1)
        if self.sums is None or values.shape[2] <= self.sums:
            return values
        generator = torch.Generator().manual_seed(self.seed)
        seed = int(torch.randint(2**62, (), generator=generator, device="cpu"))
        generator.manual_seed(seed)  # not the seed of the points
        coins = torch.randint(2, (values.shape[2], self.sums), generator=generator, device="cpu")
        return values @ (2 * coins - 1).to(values)

    def _pairs(self, quantity: Quantity, v: Tensor | None) -> Tensor:
        """Return a quantity for every pair of mirrored points: [B, Q / 2, P], or [B, Q / 2, P, n]."""
        if quantity == "value" or not self.pathwise:
            with torch.no_grad():
                each = self._by_stein(quantity, v)
        elif self.pathwise == 1:
            each = self._from_slopes(quantity, v)
        else:
            ways = [self._along_points, self._in_reverse]
            if self.control.outer.head is not None or self.control.memory.output_shape == () or self.sums is not None:
                ways.reverse()  # few numbers per point: all parameters in one pass
            try:
                each = ways[0](quantity, v)
            except RuntimeError:  # an operation without a forward mode, or without a second derivative
                each = ways[1](quantity, v)
        each, half = each.detach(), self.u.shape[1] // 2  # a module has parameters that require grad
        return 0.5 * (each[:, :half] + each[:, half:])

    def _by_stein(self, quantity: Quantity, v: Tensor | None) -> Tensor:
        values, u = self._each(self.x.double()), self.u[:, :, None]
        if quantity == "value":
            return values
        center = self._numbers(self.control.coefficient * self._predicted(self.x[:, None])).double()
        change = (values - center)[..., None]
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

    def _from_slopes(self, quantity: Quantity, v: Tensor | None) -> Tensor:
        slopes, u = self._in_reverse("gradient", None), self.u[:, :, None]
        if quantity == "gradient":
            return slopes
        if quantity == "hessian_diagonal":
            return slopes * u / self.sigma
        assert v is not None
        v = v.double()[:, None, None]
        rows, columns = slopes * (u * v / self.sigma).sum(-1, keepdim=True), (slopes * v).sum(-1, keepdim=True) * u
        return 0.5 * (rows + columns / self.sigma)  # as a product with the symmetric Hessian

    def _in_reverse(self, quantity: Quantity, v: Tensor | None) -> Tensor:
        with torch.inference_mode(False), torch.enable_grad(), without_autocast(self.x.device):
            z = (self.x.double()[:, None] + self.sigma * self.u).to(self.x.dtype).requires_grad_()
            values = self.control.coefficient * self._predicted(z)
            outputs = self._numbers(values).unbind(2)

            def gradient(of: Tensor, *, graph: bool = False) -> Tensor:
                """[B, Q, n]"""
                if not of.requires_grad:
                    return torch.zeros_like(z)
                (found,) = torch.autograd.grad(of.sum(), z, create_graph=graph, retain_graph=True, allow_unused=True)
                return torch.zeros_like(z) if found is None else found

            if quantity == "gradient":
                return torch.stack([gradient(one) for one in outputs], 2).double()
            found = []
            for one in outputs:
                slopes = gradient(one, graph=True)
                if v is not None:
                    found.append(gradient((slopes * v[:, None]).sum(2)))
                else:
                    found.append(torch.stack([gradient(slopes[..., i])[..., i] for i in range(z.shape[2])], 2))
            return torch.stack(found, 2).double()

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


def measure(control: Control, x: Tensor, aux: Sequence[Tensor], sigma: Tensor, order: int, seed: int) -> None:
    """Choose how the term at x [B, n] is differentiated, `Memory.pathwise`.

    It is chosen at the first call after a fit. At the later ones a head or a surrogate of the caller's may turn out to
    have jumps or kinks that were not met before.

    Pathwise derivatives are taken as far as the losses are smooth. With few parameters these and Stein's sums are
    computed for a few elements of the batch, and the variances of the derivative of this order compared. The pathwise
    derivatives of a table, a tree or a model outside of autograd are 0, without variance, and wrong. The choice is left
    open where the losses are constant wherever they were looked at: both derivatives are 0 there.
    """
    memory, (B, n) = control.memory, x.shape
    if memory.pathwise == 0 or (memory.pathwise and known_smooth(control)):
        return
    with torch.inference_mode(False), without_autocast(x.device):  # which would round derivatives, too
        u = nodes(seed, point_count(control, B, n, 2), n, B).to(x.device)
        orders = _smooth_orders(control, x, aux, sigma, u, seed)
        if memory.pathwise and orders in (None, memory.pathwise):
            return
        if orders and n <= MOST_STEIN:
            tried = nodes(seed, _TRIED_POINTS, n, B).to(x.device) if control.costly else u
            few = [one[:_TRIED].clone() for one in (x, *aux)]
            term = SurrogateTerm(memory.surrogate, control, few[0], few[1:], sigma, tried[:_TRIED], orders, seed, _SUMS)
            orders = _best_way(term, "gradient" if order == 1 else "hessian_diagonal")
    memory.pathwise = orders


def _best_way(term: SurrogateTerm, quantity: Quantity) -> int:
    """Return how many derivatives to take along the points: least variance, times cost if a point is costly."""
    ways = {0: 1.0, term.pathwise: 1.0}
    if term.control.costly and term.pathwise == 2 and quantity != "gradient":
        ways = {0: 1.0, 1: 3.0, 2: 3.0 * (2 + len(term.sigma))}  # losses, slopes, and products for all parameters
    variances = {way: float(replace(term, pathwise=way).variance_of_pairs(quantity).sum()) for way in ways}
    return min(ways, key=lambda way: ways[way] * variances[way])


def point_count(control: Control, B: int, n: int, pathwise: int) -> int:
    """Return how many points of the term each element of a batch has."""
    few = control.costly and control.outer.linear  # the logarithm of a mean over few points is biased
    return per_element(control.memory.draws, n, B, pathwise=pathwise, costly=few)


def _smooth_orders(
    control: Control, x: Tensor, aux: Sequence[Tensor], sigma: Tensor, u: Tensor, seed: int
) -> int | None:
    """Return how many pathwise derivatives are right, as far as is known; None where the losses are constant."""
    memory, count = control.memory, u.shape[:2].numel()
    if memory.pathwise:  # so many were right up to now: a shorter look, as the term itself is looked at
        return smooth_orders(control, x, aux, sigma, seed, most=memory.pathwise, points=count // _SHORTER)
    step = -(-count // _LOOKED)
    looked = (x[:, None] + sigma * u).flatten(0, 1)[::step].to(x.dtype)
    check_repeats(memory.surrogate, looked)
    found = jumps(in_coordinates(memory.surrogate), looked)
    if found is not False:
        return None if found is None else 0
    return 2 if known_smooth(control) else smooth_orders(control, x, aux, sigma, seed)
