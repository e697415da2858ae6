"""Gauss-Newton on a sparse Jacobian in noise: all evaluations nearby tell the Jacobian and the output at the center.

No single output is trusted. An iteration evaluates the center twice, and samples around it. The sparse regression on
all kept evaluations nearby has a constant, the output at the center. Its noise falls as evaluations are added, and so
do the errors of the slopes. The step minimises the model and, in it, the variance of the predicted outputs: the sum of
squares of (error of a slope times step). So it is short along directions that noise hides. At a kink of the loss the
step is that of `local_steps`. The next regression tells what the step has achieved, and the radius follows.

The two values at the center tell the noise of the outputs. What the regression leaves beyond noise is curvature. Then
samples come nearer, as long as the change that the slopes predict exceeds the noise; below that they go apart again.

It does not hop, and it does not end by itself: with further evaluations it becomes more exact.
"""

import math
from dataclasses import replace

import torch
from torch import Tensor

from torch_zerohess.linalg.krylov import krylov_steps
from torch_zerohess.search.local_method import LocalMethod, LocalSettings
from torch_zerohess.search.local_progress import LocalProgress
from torch_zerohess.search.local_steps import local_steps
from torch_zerohess.search.method import Settings
from torch_zerohess.search.random_points import normal
from torch_zerohess.search.state import Best, Evaluated
from torch_zerohess.surrogates.loss_curvature import loss_curvature
from torch_zerohess.surrogates.sparse_evidence import Evidence
from torch_zerohess.surrogates.sparse_fit import FEWEST_SAMPLES, fit_sparse

_REACH = 2.0
"""Distance from the center, over sigma, up to which evaluations are in the regression."""
_KEPT, _HELD = 1024, 1 << 25
"""Evaluations that are kept, and numbers of their points and outputs, at most."""
_GROWTH = 8
"""A batch has one sample for so many evaluations that are kept, or as many as the first one."""
_NEARER = 0.7
"""Factor of sigma."""
_CURVED = 1.1
"""What a regression leaves, over the noise, from which on it is curvature."""
_GOOD, _BAD = 0.7, 0.25
"""Parts of the promised decrease above and below which the radius changes."""
_LONGER, _SHORTER, _WIDEST = 2.0, 0.5, 2.0
"""Factors of the radius, and the largest one."""
_WORSE = 2.0
"""Standard errors of a loss by which it must rise before a step is undone."""
_ITERATIONS = 100
"""Products of the Hessian for a step."""


def local_method(settings: Settings, own: LocalSettings) -> LocalMethod:
    """Return the search by a sparse Jacobian: in noise, or without."""
    return NoisyLocalMethod(settings, own) if settings.noise else LocalMethod(settings, own)


class NoisyLocalMethod(LocalMethod):
    """The search of `LocalGaussNewton` in noise, in units of its sigma."""

    averages = True

    def samples(self, known: LocalProgress, generator: torch.Generator) -> tuple[LocalProgress, Tensor]:
        """Draw samples from N(center, sigma^2), mirrored into the bounds, after the center, twice."""
        count = max(known.samples, len(known.points) // _GROWTH)
        u = normal(generator, known.center, count, self.settings.n)
        points = self.settings.inside(known.center + known.sigma * u)
        return known, torch.cat([known.center.expand(2, -1), points]) if len(known.output) else points

    def next(
        self, known: LocalProgress, evaluated: Evaluated, generator: torch.Generator
    ) -> tuple[LocalProgress, Tensor]:
        """Fit, judge the last step, and take the next one; then ask for the center and samples."""
        known = known.counted(evaluated)
        if known.done:
            return known, known.center[None][:0]
        return self.asked(self.sampled(known, evaluated), generator)

    def asked(self, known: LocalProgress, generator: torch.Generator) -> tuple[LocalProgress, Tensor]:
        return self.samples(known, generator)

    def started(self, evaluated: Evaluated) -> LocalProgress | None:
        if evaluated.outputs is None or evaluated.outputs.shape[1] == 1:
            return None
        known = replace(self.begun(), center=evaluated.points[0], shape=evaluated.shape, evaluations=len(evaluated))
        known = self.sampled(known, evaluated)
        return None if known.jacobian is None else known

    def sampled(self, known: LocalProgress, evaluated: Evaluated) -> LocalProgress:
        """Keep the evaluations with finite values; the first two tell the noise of the outputs."""
        assert evaluated.outputs is not None
        if not len(known.output):
            first = Best(known.center, float(evaluated.losses[0]), known.sigma)
            known = replace(known, output=evaluated.outputs[0].clone(), loss=first.loss, best=first)
            known.check_outputs()
        elif len(evaluated) > 1 and bool(evaluated.finite[:2].all()):
            own = 0.5 * float((evaluated.outputs[0] - evaluated.outputs[1]).square().mean())
            known = replace(known, variance=own if math.isnan(known.variance) else 0.5 * (own + known.variance))
        told = evaluated.those(evaluated.finite)
        assert told.outputs is not None
        points = torch.cat([known.points, told.points]) if len(known.points) else told.points
        outputs = torch.cat([known.outputs, told.outputs]) if len(known.outputs) else told.outputs
        most = max(min(_KEPT, _HELD // (points.shape[1] + outputs.shape[1])), 2 * known.samples)
        return self.renewed(replace(known, points=points[-most:], outputs=outputs[-most:]), told)

    def renewed(self, known: LocalProgress, evaluated: Evaluated) -> LocalProgress:
        """Fit the Jacobian and the output at the center; judge the last step, and take the next one."""
        settings = self.settings
        assert evaluated.outputs is not None
        assert settings.loss is not None
        near = (known.points - known.center).norm(dim=1) <= _REACH * known.sigma * math.sqrt(settings.n)
        count = int(near.sum())
        if count < FEWEST_SAMPLES or not len(evaluated):
            return known
        u, changes = self._relative(known, known.points[near], known.outputs[near])
        fitted = fit_sparse(u, changes, known.shape, self.own.sparse)
        evidence = known.evidence or Evidence.none(settings.n, u.device)
        new = self._relative(known, evaluated.points, evaluated.outputs)
        known = known.fitting(fitted, evidence.with_batch(fitted, known.fitted, *new))
        jacobian = known.jacobian
        assert jacobian is not None
        left = (changes - jacobian.matvec(u).flatten(1)).double()
        constant = left.mean(0)
        output = known.output + known.sigma * constant
        free = max(count - 1 - int(jacobian.found.sum()) / len(output), 1.0)
        rest = known.sigma**2 * float((left - constant).square().sum()) / (free * len(output))
        predicted, error, before = known.loss, settings.noise / math.sqrt(count), known.before
        known = replace(known, output=output, loss=float(settings.loss(output.view(known.shape))))
        if before is not None and known.loss - before.loss > _WORSE * error:
            return self._undone(known, before)
        sigma = self._distance(known, rest)
        known = replace(known, radius=self._radius(known, predicted, error))
        known = replace(known, best=Best(known.center, known.loss, known.sigma))
        return replace(self._stepped(known), sigma=sigma)

    def width(self, known: LocalProgress) -> Tensor:
        """Return the length of the last step for every parameter; infinity where the Jacobian does not predict."""
        length = math.inf
        if known.before is not None and known.predicts:
            length = float((known.center - known.before.point).norm()) / math.sqrt(self.settings.n)
        return torch.full_like(known.center, length)

    def _relative(self, known: LocalProgress, points: Tensor, outputs: Tensor) -> tuple[Tensor, Tensor]:
        """Return directions from the center and changes of the output along them, in units of sigma, float32."""
        return ((points - known.center) / known.sigma).float(), ((outputs - known.output) / known.sigma).float()

    def _undone(self, known: LocalProgress, before: Best) -> LocalProgress:
        """Return to where the last step began, and sample nearer."""
        assert known.jacobian is not None
        return replace(
            known,
            best=before,
            center=before.point,
            output=known.output + known.jacobian.matvec(before.point - known.center).flatten(),
            loss=before.loss,
            before=None,
            radius=_SHORTER * known.radius,
            sigma=max(self.own.least_sigma, _NEARER * known.sigma),
        )

    def _radius(self, known: LocalProgress, predicted: float, error: float) -> float:
        """Return the radius after what the last step has achieved.

        predicted: loss at its end by the model before it.
        error: standard error of the loss at the center.
        """
        before = known.before
        if before is None or before.loss - predicted <= error:
            return known.radius
        achieved = (before.loss - known.loss) / (before.loss - predicted)
        longer = min(_LONGER * known.radius, _WIDEST) if achieved > _GOOD else known.radius
        return _SHORTER * known.radius if achieved < _BAD else longer

    def _distance(self, known: LocalProgress, rest: float) -> float:
        """Return the sigma of the next samples. rest: variance of what the regression leaves."""
        assert known.jacobian is not None
        explained = known.jacobian.explained
        told = rest * explained / max(1.0 - explained, torch.finfo(torch.float32).eps)
        if rest > _CURVED * known.variance and told > known.variance:
            return max(self.own.least_sigma, _NEARER * known.sigma)
        return min(1.0, known.sigma / _NEARER) if told < known.variance else known.sigma

    def _stepped(self, known: LocalProgress) -> LocalProgress:
        """Go to the end of a step."""
        assert known.jacobian is not None
        assert self.settings.loss is not None
        end = (known.center + self._step(known)).clamp(self.settings.lower, self.settings.upper)
        output = known.output + known.jacobian.matvec(end - known.center).flatten()
        loss, before = float(self.settings.loss(output.view(known.shape))), known.best
        return replace(known, center=end, output=output, loss=loss, before=before, iterations=known.iterations + 1)

    def _step(self, known: LocalProgress) -> Tensor:
        """Return the step to the minimum of the model within the radius [n]."""
        settings, jacobian, x, loss = self.settings, known.jacobian, known.center, self.settings.loss
        assert jacobian is not None
        assert loss is not None
        output, radii = known.output.view(known.shape), x.new_tensor([known.radius * math.sqrt(settings.n)])
        lower, upper = settings.lower - x, settings.upper - x
        kinked = local_steps(loss, output, jacobian, radii, lower, upper)
        if kinked.promised is not None:
            return kinked.steps[0]
        gradient, product = self._derivatives(known)
        free = (~(((lower >= 0) & (gradient > 0)) | ((upper <= 0) & (gradient < 0)))).to(gradient)
        uncertain = self._uncertain(known)
        return krylov_steps(
            lambda v: free * (product(free * v) + uncertain * v), free * gradient, radii, iterations=_ITERATIONS
        )[0]

    def _uncertain(self, known: LocalProgress) -> Tensor:
        """Return the curvatures of the expected loss [n] by the errors of slopes.

        They take the diagonal of the Hessian of the loss: products with signs tell it up to the other elements.
        """
        jacobian, loss = known.jacobian, self.settings.loss
        assert jacobian is not None
        assert loss is not None
        signs = torch.ones_like(known.output)
        signs[1::2] = -1.0
        expanded = loss_curvature(loss, known.output.view(known.shape))
        bent = (expanded.product(signs.view(known.shape)).flatten() * signs).clamp_min(0.0)
        squares = bent[:, None] * (jacobian.standard_error * jacobian.found).double().square()
        return known.center.new_zeros(self.settings.n).index_add_(0, jacobian.index.flatten(), squares.flatten())
