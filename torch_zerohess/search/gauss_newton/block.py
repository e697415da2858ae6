"""Gauss-Newton for outputs of many parameters: a smoothed Jacobian that is renewed block by block.

The Jacobian J [n, m] of the outputs is sampled along orthogonal directions, from f(x + d) - f(x) with |d| = sigma
sqrt(n). An iteration renews J along a block of them; across them J stays as it was. Every direction of a basis is used
once before the next basis is drawn.

    J <- J + D^T (D D^T)^-1 (f(x + D) - f(x) - D J)            D [k, n], the steps in a block

Steps of several lengths then minimise the model g J^T s + s J H J^T s / 2, where g and H are gradient and Hessian of
the loss after the output; see `by_samples`. Parameters that a bound holds stay. At a kink of the loss the quadratic
is wrong, and the loss of the linear outputs itself is minimised; see `checked_steps`. Sigma is a share of the radius.
The same formula with D = s corrects J along the step that was taken (Broyden 1965).

`Descent` fits a linear model to all evaluations near x, which suits few parameters. That model has as many unknowns per
element of the output as there are parameters: with a thousand parameters it steps in the span of a few samples only.
"""

from __future__ import annotations  # signatures print names of types, not what they stand for

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from torch_zerohess.arguments import checked_number
from torch_zerohess.linalg.krylov import are_free
from torch_zerohess.linalg.subproblem import damped_steps
from torch_zerohess.search.gauss_newton.by_samples import STEP_LENGTHS, GaussNewton, JacobianProgress
from torch_zerohess.search.gauss_newton.kinked_steps import LITTLE, Steps, checked_steps, linear_outputs
from torch_zerohess.search.protocol.ask_tell import AskTell
from torch_zerohess.search.protocol.method import Settings
from torch_zerohess.search.protocol.random_points import orthonormal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.space import Bounds, Vector
from torch_zerohess.search.protocol.state import Best, Evaluated
from torch_zerohess.search.protocol.told_values import check_range
from torch_zerohess.surrogates.loss_curvature import alternating, loss_curvature
from torch_zerohess.surrogates.surrogate import raised, scaled

_RIDGE = 1e-6
"""Added to D D^T, in units of its mean diagonal: bounds can make the steps of a block dependent."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockProgress(JacobianProgress):
    """The output at the center, the Jacobian there, and the samples asked for next."""

    wanted: int
    """Samples that are still wanted in this iteration."""
    unused: Tensor
    """Directions [k, n] of the latest basis that were not sampled yet, float32."""
    jacobian: Tensor
    """[n, m], float32: errors of sampling are far above its rounding. Empty before the first values."""


class BlockMethod(GaussNewton[BlockProgress]):
    """The search of `BlockGaussNewton`, in units of its sigma."""

    engine = "block_gauss_newton"
    progress = BlockProgress

    def __init__(self, settings: Settings, *, radius: float, share: float, block: float) -> None:
        super().__init__(settings)
        self.radius, self.share, self.block = radius, share, block

    def begun(self) -> BlockProgress:
        start, sigma = self.settings.start, self.distance(self.radius)
        return BlockProgress(
            best=Best(start, sigma=sigma),
            center=start,
            sigma=sigma,
            radius=self.radius,
            wanted=self.settings.n,
            unused=start.new_empty(0, len(start), dtype=torch.float32),
            output=start.new_empty(0),
            jacobian=start.new_empty(0, dtype=torch.float32),
        )

    def samples(self, known: BlockProgress, generator: torch.Generator) -> tuple[BlockProgress, Tensor]:
        """Ask for samples along the next directions, as many as are wanted and left of the basis."""
        n, unused = self.settings.n, known.unused
        if not len(unused):
            basis = orthonormal(torch.randn(n, n, generator=generator, dtype=torch.float32, device="cpu"))
            unused = basis.to(known.center.device)
        steps = known.sigma * math.sqrt(n) * unused[: known.wanted].double()
        lower, upper = self.settings.lower, self.settings.upper
        there, back = ((known.center + sign * steps).clamp(lower, upper) for sign in (1.0, -1.0))
        farther = (back - known.center).norm(dim=1) > (there - known.center).norm(dim=1) + 1e-9 * known.sigma
        points = torch.where(farther[:, None], back, there)  # away from a bound that is near
        return replace(known, unused=unused), points

    def renewed(self, known: BlockProgress, evaluated: Evaluated) -> BlockProgress:
        """Correct the Jacobian along the samples; steps follow when no more are wanted."""
        count, sound = len(evaluated), evaluated.sound
        assert sound.outputs is not None
        if not len(known.jacobian) and len(sound):
            check_range("BlockGaussNewton", (sound.outputs - known.output) / known.sigma)
        jacobian = (
            known.jacobian if len(known.jacobian) else known.jacobian.new_zeros(self.settings.n, len(known.output))
        )
        jacobian = broyden_update(jacobian, sound.points - known.center, sound.outputs - known.output)
        wanted = known.wanted - count
        phase: Literal["sample", "trial"] = "sample" if wanted > 0 else "trial"
        return replace(known, jacobian=jacobian, unused=known.unused[count:], wanted=wanted, phase=phase)

    def solved(self, known: BlockProgress, radii: Tensor) -> Steps:
        """Solve the model for the parameters that no bound holds, see `damped_steps` and `checked_steps`."""
        x, jacobian, (gradient, hessian) = known.center, known.jacobian, self._derivatives(known)
        lower, upper = self.settings.lower - x, self.settings.upper - x
        free = are_free(torch.zeros_like(x), gradient, lower, upper) > 0.0
        steps = x.new_zeros(len(radii), len(x))
        if bool(free.any()):
            steps[:, free] = damped_steps(gradient[free], hessian[free][:, free], radii)

        outputs = linear_outputs(
            self.settings.white_box,
            known.shaped_output,
            lambda s: (s.float() @ jacobian).double(),
            lambda w: (jacobian @ w.float()).double(),
        )
        widths = jacobian.double().norm(dim=0) * (float(radii[-1]) / math.sqrt(self.settings.n))
        bent = ((steps @ hessian) * steps).sum(1)
        return checked_steps(outputs, steps, gradient, bent, widths, radii, lower, upper)

    def taken(self, known: BlockProgress, evaluated: Evaluated) -> BlockProgress:
        return super().taken(replace(known, wanted=max(1, round(self.block * self.settings.n))), evaluated)

    def gradient(self, known: BlockProgress) -> Tensor:
        return self._derivatives(known)[0]

    def moved(self, known: BlockProgress, step: Tensor, change: Tensor) -> BlockProgress:
        return replace(known, jacobian=broyden_update(known.jacobian, step[None], change[None]))

    def arrived(self, known: BlockProgress) -> BlockProgress:
        """Begin again or end; it has arrived only where outputs change, and their linear model promises nothing."""
        longest = known.center.new_tensor([STEP_LENGTHS[-1] * self.radius * math.sqrt(self.settings.n)])
        promised = self.solved(known, longest).promised
        if bool(known.jacobian.any()) and (promised is None or promised <= LITTLE * abs(known.loss)):
            known = known.arriving(known.here)
        return super().arrived(replace(known, wanted=self.settings.n))

    def distance(self, radius: float) -> float:
        return self.share * radius

    def derivatives_at_center(self, known: BlockProgress) -> tuple[Tensor, Tensor] | None:
        incomplete = not len(known.output) or (known.iterations == 0 and known.phase == "sample")
        return None if incomplete else self._derivatives(known)

    def _derivatives(self, known: BlockProgress) -> tuple[Tensor, Tensor]:
        """Gradient [n] and Gauss-Newton Hessian [n, n] of the loss at the center, float64."""
        size = _largest(known.jacobian)
        jacobian = known.jacobian / size  # squares of float32 do not overflow
        directions = jacobian.view(-1, *known.shape)
        loss = loss_curvature(self.settings.white_box, known.shaped_output)
        _, unit = scaled(loss.product(alternating(loss.slope)))  # a second derivative may be beyond float32
        slope, bend = loss.slope.flatten(), loss.products(directions, unit)
        steep, bent = _largest(slope), _largest(bend)
        gradient, hessian = jacobian @ (slope / steep).float(), jacobian @ (bend / bent).mT
        return size * steep * gradient.double(), size**2 * bent * unit * hessian.double()


class BlockGaussNewton(AskTell[BlockProgress]):
    """Gauss-Newton for a black box [n] -> [*out] of a hundred parameters and more, with a white-box loss after it.

    It evaluates n + 1 points before its first step, and then a block of n/4 and six steps per iteration. It does not
    need a derivative of the black box. With fewer parameters, or if the black box returns the loss alone, use
    `Descent`.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: length over which the output changes, in units of the parameters; one value, or one per parameter [n].
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch. It should be
            convex, as a mean of squares is: directions in which it bends downwards count as straight. It may have
            kinks, as a mean of magnitudes has, whose minimum is found to 1e-3 of its first value.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        radius: first length of a step, root mean square over the parameters, in units of sigma.
        share: distance of the samples, in units of the radius.
        block: samples of an iteration, in units of n.
        restarts: how often to begin again with the first radius after the search has arrived.
        tolerance: radius, in units of sigma, at which the search has arrived.
        seed: of the directions; from torch's global generator if None.

    Raises ValueError for settings out of range, TypeError for settings of another type.

    Example:
        >>> A = torch.randn(200, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        >>> search = BlockGaussNewton(torch.ones(100).double(), sigma=1.0, loss=lambda y: y.square().mean(), seed=0)
        >>> while search.evaluations < 300:
        ...     search.tell(search.ask() @ A.mT)
        >>> search.value < 1e-3  # of 100
        True
    """

    def __init__(
        self,
        x0: Vector,
        *,
        sigma: float | Vector,
        loss: Callable[[Tensor], Tensor],
        bounds: Bounds | None = None,
        radius: float = 0.5,
        share: float = 0.1,
        block: float = 0.25,
        restarts: int = 10,
        tolerance: float = 5e-4,
        seed: int | None = None,
    ) -> None:
        for name, value, most in (("radius", radius, math.inf), ("share", share, 1.0), ("block", block, 1.0)):
            checked_number(name, value, above=0.0, most=most, below=math.inf)
        if not callable(loss):
            raise ValueError(f"loss must be a function of one output, got {loss!r}: without one use Descent")
        self._own = {"radius": radius, "share": share, "block": block}
        super().__init__(x0, sigma=sigma, bounds=bounds, loss=loss, restarts=restarts, tolerance=tolerance, seed=seed)

    def _make(self, settings: Settings) -> BlockMethod:
        return BlockMethod(settings, **self._own)


def broyden_update(jacobian: Tensor, steps: Tensor, changes: Tensor) -> Tensor:
    """Return the Jacobian [n, m] nearest to `jacobian` that explains changes [k, m] of the output along steps [k, n].

    Nearest in the Frobenius norm: with one step it is Broyden's update. A step of no length has no effect.
    """
    long = steps.abs().amax(1) > 0.0
    if not bool(long.any()):
        return jacobian
    steps, changes = steps[long], changes[long]
    length = steps.norm(dim=1).mean().clamp_min(torch.finfo(torch.float64).tiny)
    d, c = (steps / length).float(), (changes / length).float()
    factor = torch.linalg.cholesky(raised(d @ d.mT, _RIDGE))
    return torch.addmm(jacobian, d.mT, torch.cholesky_solve(c - d @ jacobian, factor))


def _largest(values: Tensor) -> float:
    """Largest magnitude, 1 if all are zero."""
    return float(values.abs().max()) or 1.0
