"""Gauss-Newton for outputs whose elements depend on few parameters each: thousands of parameters, few evaluations.

The start and a few dozen samples of all parameters at once tell a sparse Jacobian of the smoothed output, row by row
(`surrogates.sparse_fit`). It takes about s log n samples for s parameters per row, where a dense Jacobian takes n.

An iteration fits the Jacobian J to new samples, with the old J as the prior. Steps of several lengths then minimise
the model g J s + s J^T H J s / 2 by conjugate gradients, where g and H are gradient and Hessian of the loss after the
output; see `gauss_newton`. If the output at the end of the step was predicted well, the next steps use the same J.
Sigma is a share of the radius.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.linalg.krylov import krylov_steps
from torch_zerohess.search.gauss_newton import GaussNewton, JacobianProgress, check_share
from torch_zerohess.search.method import Settings
from torch_zerohess.search.protocol import AskTell
from torch_zerohess.search.random_points import normal, reflect
from torch_zerohess.search.space import Bounds
from torch_zerohess.search.state import Best, Evaluated, agreeing
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES, SparseSettings, check_samples, fit_sparse
from torch_zerohess.surrogates.sparse_jacobian import SparseJacobian

_TRUSTED = 0.9
"""Share of the held-out change. If the Jacobian predicts more, the first radius is at least 1, as for the samples."""
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
        cls,
        settings: Settings,
        *,
        keep: int | None = None,
        rate: float = 0.1,
        grid: tuple[int, ...] | None = None,
        **own: Any,
    ) -> "LocalSettings":
        """Check what a caller gave; ValueError for a setting out of range."""
        if not callable(settings.loss):
            raise ValueError(
                f"loss must be a function of one output for the engine 'local', got {settings.loss!r}: without one use "
                "engine='descent'"
            )
        result = cls(SparseSettings.checked(settings.n, keep=keep, rate=rate, grid=grid), **own)
        for name, most in (("radius", math.inf), ("share", 1.0), ("least_sigma", 1.0)):
            check_share(name, getattr(result, name), most)
        check_samples(result.samples, result.sparse.keep)
        return result


@dataclass(frozen=True, eq=False, kw_only=True)
class LocalProgress(JacobianProgress):
    """The output at the center, the sparse Jacobian there, and the samples asked for next."""

    jacobian: SparseJacobian | None = None
    """float32: errors of sampling are far above its rounding."""
    samples: int
    """Of the next batch."""


class LocalMethod(GaussNewton[LocalProgress]):
    """The search of `LocalGaussNewton`, in units of its sigma."""

    engine = "local"
    progress = LocalProgress

    def __init__(self, settings: Settings, own: LocalSettings) -> None:
        super().__init__(settings)
        self.own, self.radius = own, own.radius

    def begun(self) -> LocalProgress:
        start = self.settings.start
        return LocalProgress(
            best=Best(start),
            center=start,
            radius=self.radius,
            output=start.new_empty(0),
            samples=self.own.samples,
        )

    def started(self, evaluated: Evaluated) -> LocalProgress | None:
        """Return the progress after the start and samples around it at sigma; None if they give no Jacobian."""
        if evaluated.outputs is None or evaluated.outputs.shape[1] == 1:
            return None
        known = replace(self.begun(), shape=evaluated.shape, evaluations=len(evaluated)).recorded(evaluated)
        known = self.sampled(known, evaluated)
        return known if known.phase == "trial" else None

    def samples(self, known: LocalProgress, generator: torch.Generator) -> tuple[LocalProgress, Tensor]:
        """Draw samples from N(center, sigma^2), mirrored into the bounds."""
        u = normal(generator, known.center, known.samples, self.settings.n)
        return known, reflect(known.center + known.sigma * u, self.settings.lower, self.settings.upper)

    def renewed(self, known: LocalProgress, evaluated: Evaluated) -> LocalProgress:
        """Fit the Jacobian to samples; too few of them are drawn again."""
        if len(known.output) == 1:
            raise ValueError(
                "the engine 'local' needs an output of many numbers, each of few parameters, got an output of one "
                "number: use engine='descent'"
            )
        first, told = known.evaluations == len(evaluated) + 1, evaluated.those(evaluated.finite)
        assert told.outputs is not None
        if len(told) < FEWEST_SAMPLES:
            return known
        u = ((told.points - known.center) / known.sigma).float()
        changes = ((told.outputs - known.output) / known.sigma).float()
        jacobian = fit_sparse(u, changes, known.shape, self.own.sparse, known.jacobian)
        if first and jacobian.explained > _TRUSTED:
            known = replace(known, radius=max(1.0, known.radius))
        return replace(known, jacobian=jacobian, phase="trial")

    def steps(self, known: LocalProgress, radii: Tensor) -> Tensor:
        """Solve the model by conjugate gradients, over the parameters that no bound holds."""
        gradient, product = self._derivatives(known)
        lower, upper, x = self.settings.lower, self.settings.upper, known.center
        held = ((x <= lower) & (gradient > 0)) | ((x >= upper) & (gradient < 0))
        free = (~held).to(gradient)
        return krylov_steps(lambda v: free * product(v), free * gradient, radii, iterations=_ITERATIONS)

    def taken(self, known: LocalProgress, evaluated: Evaluated) -> LocalProgress:
        """Take the best step; double the samples after a small gain, and halve them after a large one."""
        after = super().taken(known, evaluated)
        before, gain = known.loss, known.loss - after.loss
        count = known.samples * (2 if gain < _SLOW * abs(before) else 1) // (2 if gain > _FAST * abs(before) else 1)
        return replace(after, samples=min(max(count, self.own.samples), _MOST * self.own.samples))

    def moved(self, known: LocalProgress, step: Tensor, change: Tensor) -> LocalProgress:
        """Keep the Jacobian, without new samples, if it predicted the change of the output."""
        assert known.jacobian is not None
        miss = change - known.jacobian.matvec(step).flatten()
        faithful = float(miss.square().sum()) <= _FAITHFUL * float(change.square().sum())
        return replace(known, phase="trial" if faithful else "sample")

    def arrived(self, known: LocalProgress) -> LocalProgress:
        if known.jacobian is not None and known.jacobian.explained > _PREDICTED:
            known = agreeing(known, known.center, self.settings.tolerance)
        return super().arrived(known)

    def distance(self, radius: float) -> float:
        return min(1.0, max(self.own.share * radius, self.own.least_sigma))

    def derivatives_at_center(self, known: LocalProgress) -> tuple[Tensor, Tensor] | None:
        """None before the first Jacobian, and for more than a thousand parameters."""
        n = self.settings.n
        if known.jacobian is None or n > _FULL:
            return None
        gradient, product = self._derivatives(known)
        eye = torch.eye(n, dtype=torch.float64, device=known.center.device)
        return gradient, torch.stack([product(one) for one in eye])

    def _derivatives(self, known: LocalProgress) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Gradient [n] of the loss at the center, and the product with its Gauss-Newton Hessian, float64."""
        jacobian = known.jacobian
        assert jacobian is not None
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
        keep: parameters per output, at most; 16 if None, or all of them if they are fewer.
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
        keep: int | None = None,
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
