"""Gauss-Newton for outputs of many parameters: a smoothed Jacobian that is renewed block by block.

The Jacobian J [n, m] of the outputs is sampled along orthogonal directions, from f(x + d) - f(x) with |d| = sigma
sqrt(n). An iteration renews J along a block of them; across them J stays as it was. Every direction of a basis is used
once before the next basis is drawn.

    J <- J + D^T (D D^T)^-1 (f(x + D) - f(x) - D J)            D [k, n], the steps in a block

Steps of several lengths are then evaluated together, which costs little beside the samples. Each minimises the model
g J^T s + s J H J^T s / 2 within its length, where g and H are gradient and Hessian of the loss after the output. The
best of them is taken if it lowers the loss. Its length is the radius of the next iteration, and sigma is a share of the
radius. The same formula with D = s corrects J along the step that was taken (Broyden 1965).

`Descent` fits a linear model to all evaluations near x, which suits few parameters. That model has as many unknowns per
element of the output as there are parameters: with a thousand parameters it steps in the span of a few samples only.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torch_zerohess.search.jacobian_progress import JacobianProgress
from torch_zerohess.search.method import Method, Settings
from torch_zerohess.search.protocol import AskTell
from torch_zerohess.search.space import Bounds
from torch_zerohess.search.state import Best, Evaluated
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.quadratic import LocalModel

LENGTHS = (0.15, 0.3, 0.6, 1.0, 1.6, 2.5)
"""Of the steps that are tried, in units of the radius."""
_REFUSED = 0.4
"""Factor of the radius where no step lowers the loss."""
_SHIFTS = (1e-8, 1e8)
"""Range of the shift that shortens a step, in units of the largest curvature."""
_BISECTIONS = 50
_RIDGE = 1e-6
"""Added to D D^T, in units of its mean diagonal: bounds can make the steps of a block dependent."""


@dataclass(frozen=True, eq=False, kw_only=True)
class BlockProgress(JacobianProgress):
    """An output, the Jacobian there, and what is asked for to go on."""

    wanted: int
    """Samples that are still wanted in this iteration."""
    unused: Tensor
    """Directions [k, n] of the latest basis that were not sampled yet, float32."""
    jacobian: Tensor
    """[n, m], float32: errors of sampling are far above its rounding. Empty before the first values."""


class BlockMethod(Method[BlockProgress]):
    """The search of `BlockGaussNewton`, in units of its sigma."""

    engine = "block_gauss_newton"
    progress = BlockProgress

    def __init__(self, settings: Settings, *, radius: float, share: float, block: float) -> None:
        super().__init__(settings)
        self.radius, self.share, self.block = radius, share, block

    def first(self, generator: torch.Generator) -> tuple[BlockProgress, Tensor]:
        """Ask for the start and n samples."""
        start = self.settings.start
        nothing = start.new_empty(0)
        known = BlockProgress(
            best=Best(start, sigma=self.share * self.radius),
            center=start,
            sigma=self.share * self.radius,
            radius=self.radius,
            wanted=self.settings.n,
            unused=start.new_empty(0, len(start), dtype=torch.float32),
            output=nothing,
            jacobian=nothing.float(),
        )
        known, points = self._sample(known, generator)
        return known, torch.cat([start[None], points])

    def next(
        self, known: BlockProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[BlockProgress, Tensor]:
        """Renew the Jacobian by samples, or take the best step; then ask for what follows."""
        known = known.counted(evaluated)
        if known.done:
            return known, known.center.new_empty(0, self.settings.n)
        if known.phase == "sample":
            known = self._renewed(known, evaluated)
            return self._sample(known, generator) if known.wanted > 0 else self._try(known)
        known = self._taken(known, evaluated.those(evaluated.finite))
        if known.done:
            return known, known.center.new_empty(0, self.settings.n)
        return self._sample(known, generator)

    def model_at_best(self, known: BlockProgress) -> tuple[LocalModel, float] | None:
        """The model of the latest Jacobian, which is one at the center, without standard errors.

        None around another point, and before the Jacobian is complete.
        """
        incomplete = not len(known.output) or (known.iterations == 0 and known.phase == "sample")
        if incomplete or not torch.equal(known.best.point, known.center):
            return None
        gradient, hessian = self._derivatives(known)
        sigma, unknown = known.sigma, torch.full_like(known.center, math.inf)
        model = LocalModel(known.best.loss, sigma * gradient, sigma**2 * hessian, None, unknown, unknown.clone())
        return model, sigma

    def _sample(self, known: BlockProgress, generator: torch.Generator) -> tuple[BlockProgress, Tensor]:
        """Ask for samples along the next directions, as many as are wanted and left of the basis."""
        n, unused = self.settings.n, known.unused
        if not len(unused):
            basis = torch.linalg.qr(torch.randn(n, n, generator=generator, device="cpu"))[0]
            unused = basis.to(known.center.device)
        steps = known.sigma * math.sqrt(n) * unused[: known.wanted].double()
        there, back = (self._within(known.center + sign * steps) for sign in (1.0, -1.0))
        farther = (back - known.center).norm(dim=1) > (there - known.center).norm(dim=1) + 1e-9 * known.sigma
        points = torch.where(farther[:, None], back, there)  # away from a bound that is near
        return replace(known, phase="sample", unused=unused), points

    def _renewed(self, known: BlockProgress, evaluated: Evaluated) -> BlockProgress:
        """Correct the Jacobian along the samples, the first of which is the start at the beginning."""
        assert evaluated.outputs is not None
        if not len(known.output):
            first, evaluated = evaluated.outputs[0].clone(), evaluated.those(slice(1, None))
            known = replace(
                known,
                best=replace(known.best, loss=float(self._loss(first, known.shape))),
                output=first,
                jacobian=known.jacobian.new_zeros(self.settings.n, len(first)),
            )
        count, told = len(evaluated), evaluated.those(evaluated.finite)
        assert told.outputs is not None
        jacobian = renewed(known.jacobian, told.points - known.center, told.outputs - known.output)
        return replace(known, jacobian=jacobian, unused=known.unused[count:], wanted=known.wanted - count)

    def _try(self, known: BlockProgress) -> tuple[BlockProgress, Tensor]:
        """Ask for steps of all lengths."""
        gradient, hessian = self._derivatives(known)
        radii = gradient.new_tensor(LENGTHS) * known.radius * math.sqrt(self.settings.n)
        steps = damped_steps(gradient, hessian, radii)
        return replace(known, phase="trial"), self._within(known.center + steps)

    def _taken(self, known: BlockProgress, evaluated: Evaluated) -> BlockProgress:
        """Go to the best of the steps with finite values if it lowers the loss."""
        known = replace(known, iterations=known.iterations + 1, wanted=max(1, round(self.block * self.settings.n)))
        k = int(evaluated.losses.argmin()) if len(evaluated) else -1
        if k >= 0 and float(evaluated.losses[k]) < known.best.loss:
            assert evaluated.outputs is not None
            point, output = evaluated.points[k].clone(), evaluated.outputs[k].clone()
            step = point - known.center
            radius = float(step.norm()) / math.sqrt(self.settings.n)
            known = replace(
                known,
                best=Best(point, float(evaluated.losses[k]), self.share * radius),
                center=point,
                radius=radius,
                output=output,
                jacobian=renewed(known.jacobian, step[None], (output - known.output)[None]),
            )
        else:
            known = replace(known, radius=_REFUSED * known.radius)
        if known.radius < self.settings.tolerance:
            known = self._arrived(known)
        return replace(known, sigma=self.share * known.radius)

    def _arrived(self, known: BlockProgress) -> BlockProgress:
        """Start again with the first radius and a whole basis, or end."""
        rounds = known.rounds + 1
        if rounds > self.settings.restarts:
            message = f"steps were below {self.settings.tolerance} of sigma, {rounds} times"
            return replace(known, rounds=rounds, done=True, message=message)
        return replace(known, rounds=rounds, radius=self.radius, wanted=self.settings.n)

    def _derivatives(self, known: BlockProgress) -> tuple[Tensor, Tensor]:
        """Gradient [n] and Gauss-Newton Hessian [n, n] of the loss at the center, float64."""
        size = _largest(known.jacobian)
        jacobian = known.jacobian / size  # squares of float32 do not overflow
        directions = jacobian.view(-1, *known.shape)
        loss = loss_curvature(self._of_output, known.output.view(known.shape))
        slope, bend = loss.slope.flatten(), loss.products(directions)
        steep, bent = _largest(slope), _largest(bend)
        gradient, hessian = jacobian @ (slope / steep).float(), jacobian @ (bend / bent).mT
        return size * steep * gradient.double(), size**2 * bent * hessian.double()

    def _of_output(self, output: Tensor) -> Tensor:
        assert self.settings.loss is not None
        return self.settings.loss(output)

    def _loss(self, output: Tensor, shape: torch.Size) -> Tensor:
        with torch.no_grad():
            return self._of_output(output.view(shape)).double()

    def _within(self, points: Tensor) -> Tensor:
        return points.clamp(self.settings.lower, self.settings.upper)


class BlockGaussNewton(AskTell[BlockProgress]):
    """Gauss-Newton for a black box [n] -> [*out] of a hundred parameters and more, with a white-box loss after it.

    It evaluates n + 1 points before its first step, and then a block of n/4 and six steps per iteration. It does not
    need a derivative of the black box. With fewer parameters, or if the black box returns the loss alone, use
    `Descent`.

    Args:
        x0: start [n], float32 or float64, within the bounds.
        sigma: length over which the output changes, in units of the parameters; one value, or one per parameter [n].
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch. It should be
            convex, as a mean of squares is: directions in which it bends downwards count as straight.
        bounds: lower and upper, numbers or [n]; no point outside of them is ever asked for.
        radius: first length of a step, root mean square over the parameters, in units of sigma.
        share: distance of the samples, in units of the radius.
        block: samples of an iteration, in units of n.
        restarts: how often to begin again with the first radius after the search has arrived.
        tolerance: radius, in units of sigma, at which the search has arrived.
        seed: of the directions; from torch's global generator if None.

    Raises ValueError for settings out of range.

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
        x0: Tensor,
        *,
        sigma: float | Tensor,
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
            if not 0.0 < value <= most or value == math.inf:
                raise ValueError(f"{name} must be above 0 and at most {most}, got {value}")
        if not callable(loss):
            raise ValueError(f"loss must be a function of one output, got {loss!r}: without one use Descent")
        self._shape = {"radius": radius, "share": share, "block": block}
        super().__init__(x0, sigma=sigma, bounds=bounds, loss=loss, restarts=restarts, tolerance=tolerance, seed=seed)

    def _make(self, settings: Settings) -> BlockMethod:
        return BlockMethod(settings, **self._shape)


def renewed(jacobian: Tensor, steps: Tensor, changes: Tensor) -> Tensor:
    """Return the Jacobian [n, m] nearest to `jacobian` that explains changes [k, m] of the output along steps [k, n].

    Nearest in the Frobenius norm: with one step it is Broyden's update.
    """
    if not len(steps):
        return jacobian
    length = steps.norm(dim=1).mean().clamp_min(torch.finfo(torch.float64).tiny)
    d, c = (steps / length).float(), (changes / length).float()
    square = d @ d.mT
    square.diagonal().add_(_RIDGE * float(square.diagonal().mean()) or 1.0)
    return torch.addmm(jacobian, d.mT, torch.cholesky_solve(c - d @ jacobian, torch.linalg.cholesky(square)))


def damped_steps(gradient: Tensor, hessian: Tensor, radii: Tensor) -> Tensor:
    """Return steps s [k, n] that minimise gradient.s + s.hessian s/2 within each of the radii [k], all float64.

    s = -(hessian + shift)^-1 gradient (Levenberg-Marquardt), with the shift found by bisection of its logarithm.
    Negative curvature counts as none. Eigenvectors are as exact as the Jacobian is: float32.
    """
    size = _largest(hessian)
    values, basis = torch.linalg.eigh((hessian / size).float())
    curvature, vectors = size * values.double().clamp_min(0.0), basis.double()
    slope = vectors.mT @ gradient
    low, high = (slope.new_full((len(radii), 1), factor * size) for factor in _SHIFTS)
    for _ in range(_BISECTIONS):
        shift = (low * high).sqrt()
        long = (slope / (curvature + shift)).norm(dim=1, keepdim=True) > radii[:, None]
        low, high = torch.where(long, shift, low), torch.where(long, high, shift)
    return -(slope / (curvature + high)) @ vectors.mT


def _largest(values: Tensor) -> float:
    """Largest magnitude, 1 if all are zero."""
    return float(values.abs().max()) or 1.0
