"""Gauss-Newton for outputs whose elements depend on few parameters each: thousands of parameters, few evaluations.

The start and a few dozen samples of all parameters at once tell a sparse Jacobian of the smoothed output, row by row
(`surrogates.sparse_fit`). It takes about s log n samples for s parameters per row, where a dense Jacobian takes n.

An iteration fits the Jacobian J to new samples, with the old J as the prior, and evaluates steps of several lengths.
Each minimises the model g J s + s J^T H J s / 2 within its length, where g and H are gradient and Hessian of the loss
after the output, by conjugate gradients. The best of them is taken if it lowers the loss; its length is the next
radius. Where the output of that step was predicted well, the next steps use the same J. Sigma is a share of the radius.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.linalg.krylov import krylov_steps
from torch_zerohess.search.draws import normal, reflect
from torch_zerohess.search.jacobian_progress import JacobianProgress
from torch_zerohess.search.method import Method, Settings
from torch_zerohess.search.protocol import AskTell
from torch_zerohess.search.space import Bounds
from torch_zerohess.search.state import Best, Evaluated, agreeing
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.quadratic import LocalModel
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES, SparseSettings, check_samples, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

LENGTHS = (0.15, 0.3, 0.6, 1.0, 1.6, 2.5)
"""Of the steps that are tried, in units of the radius."""
_REFUSED = 0.4
"""Factor of the radius where no step lowers the loss."""
_TRUSTED = 0.9
"""Share of the held-out change from which on the first radius is that of the samples, 1."""
_FAITHFUL = 0.1
"""Squared error of a predicted output, over its squared change, up to which the Jacobian needs no new samples."""
_SLOW, _FAST, _MOST = 0.02, 0.1, 2
"""The next batch has twice the samples if the loss fell by less than the first share of it, and half of them if it fell
by more than the second. It has so many times the first number of samples at most."""
_PREDICTED = 0.5
"""Share of the held-out change from which on the end of a round is a minimum."""
_ITERATIONS = 100
"""Products of the Hessian for a step."""
_FULL = 1000
"""Parameters up to which `model_at_best` forms the Hessian."""


@dataclass(frozen=True)
class LocalSettings:
    """Settings that only this search has; see `LocalGaussNewton`."""

    sparse: SparseSettings
    samples: int = 32
    radius: float = 0.5
    share: float = 0.35
    least_sigma: float = 0.03

    @classmethod
    def checked(
        cls, settings: Settings, *, keep: int = 16, rate: float = 0.1, grid: tuple[int, ...] | None = None, **own: Any
    ) -> "LocalSettings":
        """Check what a caller gave; ValueError for a setting out of range."""
        if not callable(settings.loss):
            raise ValueError(
                f"loss must be a function of one output for the engine 'local', got {settings.loss!r}: without one use "
                "engine='descent'"
            )
        result = cls(SparseSettings.checked(settings.n, keep=keep, rate=rate, grid=grid), **own)
        for name, most in (("radius", math.inf), ("share", 1.0), ("least_sigma", 1.0)):
            value = getattr(result, name)
            if not 0.0 < value <= most or value == math.inf:
                raise ValueError(f"{name} must be above 0 and at most {most}, got {value}")
        check_samples(result.samples, result.sparse.keep)
        return result


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalProgress(JacobianProgress):
    """An output, the sparse Jacobian there, and what is asked for to go on."""

    jacobian: SparseJacobian | None = None
    """float32: errors of sampling are far above its rounding."""
    samples: int
    """Of the next batch."""


class LocalMethod(Method[LocalProgress]):
    """The search of `LocalGaussNewton`, in units of its sigma."""

    engine = "local"
    progress = LocalProgress

    def __init__(self, settings: Settings, own: LocalSettings) -> None:
        super().__init__(settings)
        self.own = own

    def first(self, generator: torch.Generator) -> tuple[LocalProgress, Tensor]:
        """Ask for the start and samples around it."""
        known = self.begun()
        start = self.settings.start
        return known, torch.cat([start[None], self._samples(known, generator)])

    def begun(self) -> LocalProgress:
        """Return what is known before the first values."""
        start = self.settings.start
        return LocalProgress(
            best=Best(start),
            center=start,
            radius=self.own.radius,
            output=start.new_empty(0),
            samples=self.own.samples,
        )

    def next(
        self, known: LocalProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LocalProgress, Tensor]:
        """Fit the Jacobian to samples, or take the best step; then ask for what follows."""
        known = known.counted(evaluated)
        if known.done:
            return known, known.center[None][:0]
        if known.phase == "sample":
            known = self._fitted(known, evaluated)
        else:
            known = self._taken(known, evaluated.those(evaluated.finite))
        if known.done:
            return known, known.center[None][:0]
        return self.step(known) if known.phase == "trial" else (known, self._samples(known, generator))

    def started(self, evaluated: Evaluated) -> LocalProgress | None:
        """Return what the start and samples around it at sigma tell; None if that is too little."""
        if evaluated.outputs is None or evaluated.outputs.shape[1] == 1:
            return None
        known = replace(self.begun(), shape=evaluated.shape, evaluations=len(evaluated))
        known = self._fitted(known, evaluated)
        return known if known.phase == "trial" else None

    def model_at_best(self, known: LocalProgress) -> tuple[LocalModel, float] | None:
        """The model of the latest Jacobian, which is one at the center, without standard errors.

        None around another point, and for more than a thousand parameters.
        """
        n = self.settings.n
        if known.jacobian is None or n > _FULL or not torch.equal(known.best.point, known.center):
            return None
        gradient, product = self._derivatives(known, known.jacobian)
        hessian = torch.stack([product(one) for one in torch.eye(n, dtype=torch.float64, device=known.center.device)])
        sigma, unknown = known.sigma, torch.full_like(known.center, math.inf)
        model = LocalModel(known.best.loss, sigma * gradient, sigma**2 * hessian, None, unknown, unknown.clone())
        return model, sigma

    def _samples(self, known: LocalProgress, generator: torch.Generator) -> Tensor:
        """Draw samples from N(center, sigma^2), mirrored into the bounds."""
        u = normal(generator, known.center, known.samples, self.settings.n)
        return reflect(known.center + known.sigma * u, self.settings.lower, self.settings.upper)

    def _fitted(self, known: LocalProgress, evaluated: Evaluated) -> LocalProgress:
        """Fit the Jacobian to samples, the first of which is the start at the beginning."""
        assert evaluated.outputs is not None
        first = not len(known.output)
        if first:
            output = evaluated.outputs[0].clone()
            if len(output) == 1:
                raise ValueError(
                    "the engine 'local' needs an output of many numbers, each of few parameters, got an output of one "
                    "number: use engine='descent'"
                )
            known = replace(known, output=output, best=replace(known.best, loss=float(evaluated.losses[0])))
            evaluated = evaluated.those(slice(1, None))
        told = evaluated.those(evaluated.finite)
        assert told.outputs is not None
        if len(told) < FEWEST_SAMPLES:
            return known  # ask again
        u = ((told.points - known.center) / known.sigma).float()
        changes = ((told.outputs - known.output) / known.sigma).float()
        jacobian = fit_sparse(u, changes, known.shape, self.own.sparse, known.jacobian)
        if first and jacobian.explained > _TRUSTED:
            known = replace(known, radius=max(1.0, known.radius))
        return replace(known, jacobian=jacobian, phase="trial")

    def step(self, known: LocalProgress) -> tuple[LocalProgress, Tensor]:
        """Ask for steps of all lengths."""
        assert known.jacobian is not None
        gradient, product = self._derivatives(known, known.jacobian)
        lower, upper, x = self.settings.lower, self.settings.upper, known.center
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        free = (~held).to(gradient)
        radii = gradient.new_tensor(LENGTHS) * known.radius * math.sqrt(self.settings.n)
        steps = krylov_steps(lambda v: free * product(v), free * gradient, radii, iterations=_ITERATIONS)
        return replace(known, phase="trial"), (x + steps).clamp(lower, upper)

    def _taken(self, known: LocalProgress, evaluated: Evaluated) -> LocalProgress:
        """Go to the best of the steps with finite values if it lowers the loss."""
        jacobian = known.jacobian
        assert jacobian is not None
        known = replace(known, iterations=known.iterations + 1, phase="sample")
        k = int(evaluated.losses.argmin()) if len(evaluated) else -1
        before = known.best.loss
        if k >= 0 and float(evaluated.losses[k]) < known.best.loss:
            assert evaluated.outputs is not None
            point, output = evaluated.points[k].clone(), evaluated.outputs[k].clone()
            step, change = point - known.center, output - known.output
            radius = float(step.norm()) / math.sqrt(self.settings.n)
            miss = change - jacobian.matvec(step).flatten()
            faithful = float(miss.square().sum()) <= _FAITHFUL * float(change.square().sum())
            best = Best(point, float(evaluated.losses[k]), known.sigma)
            known = replace(known, best=best, center=point, radius=radius, output=output)
            known = replace(known, phase="trial" if faithful else "sample")
        else:
            known = replace(known, radius=_REFUSED * known.radius)
        gain = before - known.best.loss
        count = known.samples * (2 if gain < _SLOW * abs(before) else 1) // (2 if gain > _FAST * abs(before) else 1)
        known = replace(known, samples=min(max(count, self.own.samples), _MOST * self.own.samples))
        if known.radius < self.settings.tolerance:
            known = self._arrived(known)
        return replace(known, sigma=min(1.0, max(self.own.share * known.radius, self.own.least_sigma)))

    def _arrived(self, known: LocalProgress) -> LocalProgress:
        """Start again with the first radius and sigma, or end."""
        rounds = known.rounds + 1
        if known.jacobian is not None and known.jacobian.explained > _PREDICTED:
            known = agreeing(known, known.center, self.settings.tolerance)
        if rounds > self.settings.restarts:
            message = f"steps were below {self.settings.tolerance} of sigma, {rounds} times"
            return replace(known, rounds=rounds, done=True, message=message)
        return replace(known, rounds=rounds, radius=self.own.radius, phase="sample")

    def _derivatives(self, known: LocalProgress, jacobian: SparseJacobian) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Gradient [n] of the loss at the center, and the product with its Gauss-Newton Hessian, float64."""
        assert self.settings.loss is not None
        loss = loss_curvature(self.settings.loss, known.output.view(known.shape))
        gradient = jacobian.rmatvec(loss.slope)
        return gradient, lambda v: jacobian.rmatvec(loss.product(jacobian.matvec(v)))


class LocalGaussNewton(AskTell[LocalProgress]):
    """Gauss-Newton for a black box [n] -> [*out] whose outputs depend on few of thousands of parameters each.

    Textures, height fields, vertices and voxels are such parameters, pixels such outputs. Which pixel depends on which
    parameter need not be known: samples of all parameters at once tell it. It evaluates the start and `samples` points
    before its first step, and `samples` and six steps per iteration. It needs no derivative of the black box. Where
    every output depends on every parameter it finds no support and does not move: use `TrustRegion`, which notices.

    A parameter that no output depends on stays where it is; `jacobian.untouched` names these parameters.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: length over which the output changes, in units of the parameters; one value, or one per parameter [n].
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch. It should be
            convex, as a mean of squares is: directions in which it bends downwards count as straight.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        grid: rows and columns (and channels) in which the parameters lie, with n numbers in all. Neighbours then share
            evidence, which helps where outputs depend on patches of parameters. None: they lie in no order.
        keep: parameters per output, at most.
        samples: of an iteration at first, at least keep + 2. An iteration that hardly lowers the loss doubles
            them, once; a good one halves them again.
        rate: of false discoveries among the parameters that are found in a batch.
        radius: first length of a step, root mean square over the parameters, in units of sigma. It is at least 1 if
            the first Jacobian predicts 90 % of held-out samples.
        share: distance of the samples, in units of the radius; the first ones have the distance sigma.
        least_sigma: least distance of the samples, in units of sigma.
        restarts: how often to begin again with the first radius after the search has arrived.
        tolerance: radius, in units of sigma, at which the search has arrived.
        seed: of the samples; from torch's global generator if None.

    Outputs [h, w] and [h, w, channels] are images, whose neighbouring pixels share evidence.

    Raises ValueError for settings out of range, and from the first `tell` for outputs of one number.

    Example:
        >>> target = torch.rand(20, 20, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> loss = lambda image: (image - target).square().mean()
        >>> search = LocalGaussNewton(torch.zeros(400).double(), sigma=1.0, loss=loss, seed=0)
        >>> while search.evaluations < 39:
        ...     search.tell(search.ask().view(-1, 20, 20))
        >>> search.value < 1e-3  # of 0.3
        True
    """

    def __init__(
        self,
        x0: Tensor,
        *,
        sigma: float | Tensor,
        loss: Callable[[Tensor], Tensor],
        bounds: Bounds | None = None,
        grid: tuple[int, ...] | None = None,
        keep: int = 16,
        samples: int = 32,
        rate: float = 0.1,
        radius: float = 0.5,
        share: float = 0.35,
        least_sigma: float = 0.03,
        restarts: int = 10,
        tolerance: float = 5e-4,
        seed: int | None = None,
    ) -> None:
        self._own: dict[str, Any] = {"grid": grid, "keep": keep, "samples": samples, "rate": rate}
        self._own |= {"radius": radius, "share": share, "least_sigma": least_sigma}
        super().__init__(x0, sigma=sigma, bounds=bounds, loss=loss, restarts=restarts, tolerance=tolerance, seed=seed)

    @property
    def jacobian(self) -> SparseJacobian | None:
        """The latest smoothed Jacobian, in units of the first sigma per parameter; None before the first one."""
        return self._state.progress.jacobian

    def _make(self, settings: Settings) -> LocalMethod:
        return LocalMethod(settings, LocalSettings.checked(settings, **self._own))
