"""Steps by a Gaussian process in a finite box, for an output with a loss and for a loss alone.

The process predicts the output anywhere in the box from all evaluations. The next point is the one with the lowest loss
among the outputs that lie within `_OPTIMISM` standard deviations of the prediction (Bayesian optimization of a
composite function: Astudillo and Frazier 2019). If the process knows that point already, the search evaluates the point
of the largest uncertainty, so it escapes local minima and plateaus.

In noise the best point is the one whose *predicted* output has the lowest loss. A loss has its `likeliest` scale.
"""

import math
from collections.abc import Callable
from typing import TypeVar

import torch
from torch import Tensor

from torch_zerohess.search.descent.pool_quadratic import quadratic_of_pool
from torch_zerohess.search.gaussian_process.candidates import farthest, is_known, least_known, lowest
from torch_zerohess.search.gaussian_process.loss_model import LossModel
from torch_zerohess.search.gaussian_process.progress import ProcessProgress
from torch_zerohess.search.gaussian_process.warp import LOOK, likeliest
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.random_points import normal, orthonormal
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.state import LOST, Best, Evaluated, not_finite
from torch_zerohess.surrogates.gaussian_process import HIGH_NOISES, NOISES, GaussianProcess, Spectra
from torch_zerohess.surrogates.kernels import structures
from torch_zerohess.surrogates.pool import Pool, covering
from torch_zerohess.surrogates.quadratic import LocalModel

APART = 0.05
"""Distance from a minimum that is known to the last digit within which the process has nothing to add."""
_OPTIMISM = 0.3
"""Standard deviations of the output by which a prediction may be wrong in favour of the loss."""
_EXPLORING = 2.0
"""`_OPTIMISM` in the steps after an arrival, and in all steps where the loss itself is predicted."""
_BESIDE, _EVERY = 0.5, 4
"""Spread of points around the end of a step, over the distance of the nearest evaluation. One in so many lies there."""
_SETTLED = 3
"""Steps in a row that stay within the tolerance of the best point: the search has arrived."""
_FLOOR = 1e-2
"""Least sigma, over the tolerance."""
ROUND = 2
"""Steps after an arrival, over n, that are more optimistic."""
_TELLING = 10
"""Evaluations over n + 1 from which high noise is told from fast variation."""
_PROPORTION = 1e3
"""Losses are cut above the lowest one plus this times the distance of the median from it."""
_EXPANSIONS = 3
"""Expansions of the loss around predicted minima. If none predicts the loss there, the loss itself is modelled."""
_POOL, _BATCHES = 60, 8
"""Evaluations kept, and batches of several points kept at least, unless `pool` says it."""
_MOST, _ROOM = 256, 512
"""Evaluations of the first batch, and of several, that are kept at most: P of them take P^3 operations a step."""
_WIDEST = 10.0
"""Sigma of the model at the best point, at most."""

Q = TypeVar("Q", bound=ProcessProgress)


class ProcessMethod(Method[Q]):
    """A process of the output if there is a loss, otherwise of the loss. Bounds are finite."""

    engine = "gaussian_process"

    def __init__(self, settings: Settings) -> None:
        super().__init__(settings)
        self.capacity = max(settings.pool or _POOL, 2 * settings.n + 2)  # at least the start, its samples and steps
        self._structures = structures(1 if settings.loss is None else settings.n)
        self._latest: tuple[Pool, LossModel] | None = None  # what `_model` would make again

    def take(self, known: Q, evaluated: Evaluated) -> Q:
        """Return the progress after an evaluation."""
        finite, trial, before = evaluated.finite, known.phase == "trial", known.best.point
        known = replace(
            known.told(evaluated, lost=evaluated.lacking),
            room=max(known.room, min(_BATCHES * len(evaluated), _ROOM) if evaluated.extra else 0),
            iterations=known.iterations + trial,
        )
        if self.gives_up(known):
            return known.ended_round(not_finite(known.lost), 0)
        known = self.avoiding(self.remembered(known, evaluated.those(finite)), evaluated.points[~finite])
        if evaluated.extra:
            known = replace(known, moved=max(known.moved, self._length(known.best.point - before)))
        known = self._settled(known) if trial else known
        return replace(known, center=evaluated.needed.points[-1], phase="trial")

    def gives_up(self, known: Q) -> bool:
        """Whether so many batches in a row were lost that the search ends."""
        return known.lost >= LOST

    def points(self, known: Q, generator: torch.Generator) -> tuple[Q, Tensor]:
        """Return the progress, with the noise that the process found, and the next points [K, n]."""
        best, settings = known.best.point, self.settings
        if known.done:
            return known, best[None][:0]
        if known.phase == "start" or len(known.pool) < 2:
            around = self._around(best, generator)
            return known, torch.cat([best[None], around]) if known.phase == "start" else around
        known, model, x = self._modelled(known, generator)
        process, best = model.process, known.best.point
        moved = math.inf if (explores := self.explores(known)) else self._length(x - best)
        if explores or torch.equal(x, best) or is_known(process, x):
            x = least_known(process, settings.lower, settings.upper, generator)
        return replace(known, moved=moved), x[None]

    def explores(self, known: Q) -> bool:
        """Whether to look where least is known: after an arrival if the process is one of the loss."""
        return known.exploring > 0 and not known.expands

    def more(self, known: Q, points: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """Return points around the first one, and points chosen as if the process was right about those before."""
        lower, upper, near = self.settings.lower, self.settings.upper, count // _EVERY
        if known.phase == "start" or len(known.pool) < 2:
            around = self.settings.drawn(known.center, 1.0, near, generator)
            return torch.cat([around, farthest(torch.cat([points, around]), count - near, lower, upper, generator)])
        model = self._model(known)
        reach = _BESIDE * float((known.pool.points - points[0]).norm(dim=1).min()) / math.sqrt(self.settings.n)
        near = near if 0.0 < reach < math.inf else 0
        every = [*points, *self.settings.drawn(points[0], reach, near, generator)]
        for one in every[:-1]:
            model = model.pending(one)
        while len(every) < len(points) + count:
            model = model.pending(every[-1])
            x = self._lowest(known, model, generator)
            every.append(least_known(model.process, lower, upper, generator) if is_known(model.process, x) else x)
        return torch.stack(every[len(points) :])

    def model_at_best(self, known: Q) -> tuple[LocalModel, float] | None:
        best, pool, least = known.best, known.pool, min(self.settings.n, self.capacity - 2) + 1
        return quadratic_of_pool(best, pool, self.settings.loss, known.shape, least, _WIDEST, pool.normal_weights)

    def begun(self) -> Q:
        """Return the progress before anything was evaluated."""
        start, expands = self.settings.start, self.settings.loss is not None
        best, pool = Best(start), Pool.empty(len(start), start.device)
        return self.progress(best=best, record=best, center=start, pool=pool, expands=expands, holes=start[None][:0])

    def tells_noise(self, known: Q) -> bool:
        """Whether noise is declared, or there are enough outputs to tell noise from fast variation."""
        enough = min(_TELLING * (self.settings.n + 1), self.capacity)
        return self.settings.noise > 0.0 or (self.settings.loss is not None and len(known.pool) >= enough)

    # What was evaluated.

    def remembered(self, known: Q, new: Evaluated) -> Q:
        """Add evaluations with finite values to the pool."""
        if not len(new):
            return known
        capacity = self.capacity if self.settings.pool else max(self.capacity, known.room)
        best, pool = known.best.point, known.pool
        if not len(pool):
            new = new.those(covering(new.points, new.points[int(new.losses.argmin())], min(capacity, _MOST)))
        while len(pool) + len(new) > capacity > len(new) and not known.noisy:
            pool = pool.thin(best)
        pool = pool.add(new.points, new.losses, new.outputs, best, 1.0)
        k = int(new.losses.argmin())
        if float(new.losses[k]) < known.record.loss:
            record = Best(new.points[k], float(new.losses[k]), max(known.sigma, self.settings.tolerance))
            known = replace(known, record=record, best=known.best if known.noisy else record)
        keep = None if self.settings.noise else known.record.point  # in noise it is the luckiest one
        return replace(known, pool=pool.latest(capacity, keep))

    def avoiding(self, known: Q, holes: Tensor) -> Q:
        """Note points [K, n] whose values are not finite."""
        return replace(known, holes=torch.cat([known.holes, holes])[-self.capacity :])

    def arrived(self, known: Q, reason: str, end: Best | None = None) -> Q:
        """End, or explore, after an arrival at the best point, or at `end`."""
        known = replace(known, settled=0, exploring=ROUND * self.settings.n).arriving_here(self.settings.tolerance, end)
        return known.ended_round(reason, self.settings.restarts)

    def _settled(self, known: Q) -> Q:
        """Arrive where step after step stays at the best point."""
        tolerance = self.settings.tolerance
        known = replace(
            known,
            sigma=min(max(known.moved, _FLOOR * tolerance), 1.0),
            exploring=max(known.exploring - 1, 0),
            settled=known.settled + 1 if known.moved < tolerance else 0,
        )
        if known.settled < _SETTLED:
            return known
        return self.arrived(known, f"{_SETTLED} steps in a row were below {tolerance} of sigma")

    # Where to look next.

    def _around(self, x: Tensor, generator: torch.Generator) -> Tensor:
        """Draw n orthogonal steps of length sqrt(n), mirrored into the box."""
        n = len(x)
        return self.settings.inside(x + math.sqrt(n) * orthonormal(normal(generator, x, n, n)).mT)

    def _length(self, step: Tensor) -> float:
        """Length of a step [n] in units of the first sigma sqrt(n)."""
        return float(step.norm()) / math.sqrt(self.settings.n)

    @torch.no_grad()
    def _modelled(self, known: Q, generator: torch.Generator) -> tuple[Q, LossModel, Tensor]:
        """Return a model of the loss and the point [n] where it is lowest."""
        known, model, x = (self._through_output if known.expands else self._through_losses)(known, generator)
        self._latest = known.pool, model
        return known, model, x

    @torch.no_grad()
    def _model(self, known: Q) -> LossModel:
        """Return the model of the last step: the kept one, or a new one from the same evaluations."""
        if self._latest is not None and self._latest[0] is known.pool:
            return self._latest[1]
        if not known.expands:
            return self._of_losses(known)[1]
        _, process, output = self._predicted(known)
        if known.expanded is not None:
            output = process.predict(known.expanded[None])[0]
        return self._expanded(known, process, output)

    def _through_output(self, known: Q, generator: torch.Generator) -> tuple[Q, LossModel, Tensor]:
        """Predict the output, expand the loss, and return the point [n] that is lowest."""
        known, process, output = self._predicted(known)
        loss, at = self.settings.white_box, None
        for _ in range(_EXPANSIONS):
            model = self._expanded(known, process, output)
            x = self._lowest(known, model, generator)
            output = process.predict(x[None])[0]
            if model.is_true(x, float(loss(output.view(known.shape)))):
                return replace(known, expanded=at), model, x
            at = x
        return self._through_losses(replace(known, expands=False), generator)

    def _through_losses(self, known: Q, generator: torch.Generator) -> tuple[Q, LossModel, Tensor]:
        known, model = self._of_losses(known)
        return known, model, self._lowest(known, model, generator)

    def _predicted(self, known: Q) -> tuple[Q, GaussianProcess, Tensor]:
        """Return the process of the output, and the output [m] with the lowest loss."""
        loss, pool = self.settings.white_box, known.pool
        assert pool.outputs is not None
        known, process = self._fitted(known, pool.outputs)
        outputs, values = pool.outputs, pool.values
        if known.noisy:
            outputs = process.predict(pool.points)
            values = torch.stack([loss(one.view(known.shape)).double().reshape(()) for one in outputs])
            values = values.nan_to_num(nan=math.inf, neginf=math.inf)
            known = self._judged(known, values)
        return known, process, outputs[int(values.argmin())]

    def _expanded(self, known: Q, process: GaussianProcess, output: Tensor) -> LossModel:
        """Return the model of the loss that is expanded at an output [m]."""
        optimism = _EXPLORING if known.exploring else _OPTIMISM
        return LossModel(process, output, self.settings.white_box, known.shape, optimism)

    def _of_losses(self, known: Q) -> tuple[Q, LossModel]:
        values = known.pool.values
        least, middle = float(values.min()), float(values.median())
        if middle > least:  # a value out of all proportion, such as a penalty, counts as high and no more
            values = values.clamp(max=least + _PROPORTION * (middle - least))
        spread = max(float(values.max()) - least, self.settings.noise) or 1.0
        values = (values - least) / spread  # neither their squares nor that of the noise overflow
        noise = self.settings.noise / spread
        looks, spectra = noise > 0.0 and known.iterations % LOOK == 0, Spectra(known.pool.points, self._structures)
        if not looks and (noise or self.settings.loss is None):  # the best point keeps its loss on every scale
            values = likeliest(spectra, values, noise)
        known, process = self._fitted(known, values[:, None], noise, spectra)
        if known.noisy:
            values = process.predict(known.pool.points)[:, 0]
            known = known if looks else self._judged(known, values * spread + least)
        return known, LossModel(process, values.min()[None], torch.sum, torch.Size([1]), _EXPLORING)

    def _fitted(
        self, known: Q, outputs: Tensor, deviation: float = 0.0, spectra: Spectra | None = None
    ) -> tuple[Q, GaussianProcess]:
        """Return the process of outputs [P, m]; if it ceases to find noise, the best point is `record` again.

        An output that is not finite is replaced by the output with the highest loss, and is no evidence of noise. A
        loss alone is too little evidence to tell noise from ripples: it counts as noisy only if `noise` is given.
        deviation: of repeated outputs at one point; 0 if it is not known. spectra: of the pool, if they are known.
        """
        pool, holes, noises = known.pool, known.holes, NOISES + HIGH_NOISES if self.tells_noise(known) else NOISES
        points, spectra = (torch.cat([pool.points, holes]), None) if len(holes) else (pool.points, spectra)
        if len(holes) and noises != NOISES and not self.settings.noise:
            found = GaussianProcess.fit(pool.points, outputs, noises, None, self._structures)
            noises = noises if found.noise >= HIGH_NOISES[0] else NOISES
        outputs = torch.cat([outputs, outputs[int(pool.values.argmax())].expand(len(holes), -1)])
        process = GaussianProcess.fit(
            points, outputs, noises, deviation or None, self._structures, spectra, stretched=outputs.shape[1] > 1
        )
        noisy = self.settings.noise > 0.0 or process.noise >= HIGH_NOISES[0]
        return replace(known, noisy=noisy, best=known.record if known.noisy and not noisy else known.best), process

    def _judged(self, known: Q, values: Tensor) -> Q:
        """Make the point of the pool with the lowest of values [P] the best one."""
        k = int(values.argmin())
        best = Best(known.pool.points[k], float(values[k]), max(known.sigma, self.settings.tolerance))
        return replace(known, best=best) if math.isfinite(best.loss) else known

    def _lowest(self, known: Q, model: Callable[[Tensor], Tensor], generator: torch.Generator) -> Tensor:
        """Return the point [n] where the model is lowest; near a minimum that is solved, the minimum itself."""
        best = known.best.point
        x = lowest(model, best, self.settings.lower, self.settings.upper, generator)
        return best if known.is_solved and float((x - best).norm()) < APART else x
