"""The search behind `TrustRegion` over few parameters in a finite box.

A Gaussian process (`GaussianProcess`) predicts the output anywhere in the box from all evaluations, and the white-box
loss of the prediction says where to look next: at the point with the lowest loss among the outputs that lie within
`_OPTIMISM` standard deviations of the prediction (a composite objective: Astudillo and Frazier 2019). One evaluation
follows another; each is trial and sample at once. Where nothing lower is expected, the search looks where it knows
least, so it leaves local minima and plateaus. Where outputs differ from call to call (the evidence tells, of a loss
alone `noise`) the best point is that with the lowest loss of the prediction, an average of what is around it.
"""

import math
from collections.abc import Callable
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.search.draws import normal, reflect, uniform
from torch_zerohess.surrogates.gaussian_process import HIGH_NOISES, NOISES, GaussianProcess
from torch_zerohess.surrogates.pool import Pool
from torch_zerohess.surrogates.quadratic import LocalModel, fit_outputs, fit_values, loss_derivatives

MOST = 4
"""Parameters that the candidates cover a box of."""
_OPTIMISM = 0.3
"""Standard deviations of the output by which a prediction may be wrong in favour of the loss."""
_EXPLORING = 2.0
"""The same in the steps after an arrival, and in all steps where the loss itself is predicted."""
_SCALES = (1.0, 0.5, 0.2, 0.1, 0.05, 0.02)
"""Distances of candidates from the best point."""
_CANDIDATES = 24
"""At each of these distances; four times as many all over the box."""
_REFINEMENTS = 6
_SAME = 1e-4
"""Distance below which a point is known already."""
_SETTLED = 3
"""Steps in a row that stay within the tolerance of the best point: the search has arrived."""
_REFUSED = 10
"""Outputs in a row that are not finite, after which the search ends."""
_TELLING = 10
"""Evaluations over n + 1 from which high noise is told from fast variation."""
_PROPORTION = 1e3
"""Losses are cut above the lowest one plus this times the distance of the median from it."""
_EXPANSIONS = 3
"""Around predicted minima, until one predicts the loss; a loss for which none does is itself predicted from then on."""

_STATE = (
    *("sigma", "evaluations", "iterations", "rounds", "done", "message", "phase"),
    *("best", "lowest", "best_sigma", "x", "_moved", "_settled", "_exploring", "_refused", "_expands", "_noisy"),
    *("_record", "_holes"),
)


class BoxSearch:
    """State of a search over z [n], float64, within finite lower and upper [n]; the first sigma is 1.

    One iteration is `points`, their evaluation, `take`, as in `Search`.
    """

    def __init__(
        self,
        start: Tensor,
        lower: Tensor,
        upper: Tensor,
        *,
        loss: Callable[[Tensor], Tensor] | None,
        restarts: int,
        tolerance: float,
        noise: float,
        pool: int,
        generator: torch.Generator,
    ) -> None:
        self.n, self.lower, self.upper, self.loss = len(start), lower, upper, loss
        self.restarts, self.tolerance, self.noise, self.generator = restarts, tolerance, noise, generator
        self.pool = Pool(self.n, max(pool, 2 * self.n + 2), start.device)  # at least the start, its samples and steps
        self.best = self.x = start
        self.lowest, self.sigma, self.best_sigma = math.inf, 1.0, 1.0
        self.evaluations, self.iterations, self.rounds, self.done, self.message = 0, 0, 0, False, ""
        self.phase: Literal["start", "trial"] = "start"
        self.shape = torch.Size()
        """Of an output."""
        self._moved, self._expands, self._noisy = math.inf, loss is not None, False
        self._settled = self._exploring = self._refused = 0
        self._record: list[Any] = [start, math.inf, 1.0]
        """The lowest loss that was evaluated: its point, it, and sigma then."""
        self._holes = start[None][:0]
        """Points [H, n] whose outputs were not finite."""

    def points(self) -> Tensor:
        """Draw the next points [K, n]."""
        if self.phase == "start":
            return torch.cat([self.best[None], self._around(self.best)])
        if len(self.pool) < 2:
            return self._around(self.best)
        return self._next()[None]

    def take(self, points: Tensor, losses: Tensor, outputs: Tensor | None) -> None:
        """Go on with the losses [K] and outputs [K, m] of points [K, n]."""
        outputs = losses[:, None] if outputs is None else outputs
        finite = torch.isfinite(losses) & torch.isfinite(outputs).all(1)
        self.evaluations += len(points)
        self.iterations += self.phase == "trial"
        self._refused = 0 if bool(finite.all()) else self._refused + 1
        if self._refused >= _REFUSED:
            self.done, self.message = True, f"{_REFUSED} batches in a row had values that are not finite"
            return
        self._remember(points[finite], losses[finite], outputs[finite])
        self._holes = torch.cat([self._holes, points[~finite]])[-self.pool.capacity :]
        if self.phase == "trial":
            self._settle(self._moved)
        self.x = points[-1]
        self.phase = "trial"

    def model_at_best(self) -> tuple[LocalModel, float] | None:
        """See `TrustRegion.model_at_best`."""
        outputs, sigma = self.pool.outputs, self.best_sigma
        while outputs is not None and sigma < 10.0:
            weights = torch.exp(-0.5 * ((self.pool.points - self.best) / sigma).square().sum(1))
            near = weights > 1e-3
            if int(near.sum()) > min(self.n, self.pool.capacity - 2):
                u = (self.pool.points[near] - self.best) / sigma
                if self.loss is None:
                    return fit_values(u, self.pool.values[near], weights[near]), sigma
                return fit_outputs(u, outputs[near], weights[near], self.loss, self.shape), sigma
            sigma *= 1.5
        return None

    def state_dict(self) -> dict[str, Any]:
        """Tensors, numbers, strings, lists and dicts."""
        return {
            **{name: getattr(self, name) for name in _STATE},
            "shape": list(self.shape),
            "pool": self.pool.state_dict(),
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        vars(self).update({name: state[name] for name in _STATE})
        self.shape = torch.Size(state["shape"])
        self.pool.load_state_dict(state["pool"])
        self.generator.set_state(state["generator"].cpu())

    def _remember(self, points: Tensor, losses: Tensor, outputs: Tensor) -> None:
        if not len(losses):
            return
        if not self._noisy:
            self.pool.thin(self.best)
        self.pool.add(points, losses, outputs, self.best, 1.0)
        k = int(losses.argmin())
        if float(losses[k]) < self._record[1]:
            self._record = [points[k], float(losses[k]), max(self.sigma, self.tolerance)]
            if not self._noisy:
                self.best, self.lowest, self.best_sigma = self._record

    def _settle(self, moved: float) -> None:
        """Arrive where step after step stays at the best point."""
        self.sigma = min(max(moved, 1e-2 * self.tolerance), 1.0)
        self._exploring = max(self._exploring - 1, 0)
        self._settled = self._settled + 1 if moved < self.tolerance else 0
        if self._settled >= _SETTLED:
            self._arrive(f"{_SETTLED} steps in a row were below {self.tolerance} of sigma")

    def _arrive(self, reason: str) -> None:
        """End, or explore."""
        self._settled, self._exploring = 0, 2 * self.n
        self.rounds += 1
        if self.rounds > self.restarts:
            self.done, self.message = True, f"{reason}, {self.rounds} times"

    def _around(self, x: Tensor) -> Tensor:
        """Draw n orthogonal steps of length sqrt(n), mirrored into the box."""
        directions, _ = torch.linalg.qr(self._normal(self.n, self.n))
        return reflect(x + math.sqrt(self.n) * directions.mT, self.lower, self.upper)

    def _next(self) -> Tensor:
        """Return the point [n] with the lowest optimistic loss, or the least known one if that is known already.

        A process of the loss, which has less to go by, also looks there after every arrival.
        """
        process, x = self._through_output() if self._expands else self._from_losses()
        explores = self._exploring > 0 and not self._expands
        self._moved = math.inf if explores else float((x - self.best).norm()) / math.sqrt(self.n)
        if explores or self._is_known(process, x):
            spots = self._uniform(4 * _CANDIDATES)
            x = spots[int(process.uncertainty(process.covariance(spots)).argmax())]
        return x

    def _is_known(self, process: GaussianProcess, x: Tensor) -> bool:
        """Whether there is nothing to learn at x [n]."""
        return float((process.points - x).norm(dim=1).min()) < _SAME

    @torch.no_grad()
    def _through_output(self) -> tuple[GaussianProcess, Tensor]:
        """Predict the output, expand the loss, and return the point [n] that is lowest."""
        assert self.pool.outputs is not None
        assert self.loss is not None
        process = self._fit(self.pool.outputs)
        optimism = _EXPLORING if self._exploring else _OPTIMISM
        outputs, values = self.pool.outputs, self.pool.values
        if self._noisy:
            outputs = process.predict(self.pool.points)
            values = torch.stack([self.loss(one.view(self.shape)).double().reshape(()) for one in outputs])
            values = values.nan_to_num(nan=math.inf, neginf=math.inf)
            self._judge(values)
        output = outputs[int(values.argmin())]
        for _ in range(_EXPANSIONS):
            model = LossModel(process, output, self.loss, self.shape, optimism)
            x = self._lowest(model)
            output = process.predict(x[None])[0]
            if model.is_true(x, float(self.loss(output.view(self.shape)))):
                return process, x
        self._expands = False
        return self._from_losses()

    def _from_losses(self) -> tuple[GaussianProcess, Tensor]:
        """Predict the loss, and return the point [n] that is lowest."""
        values = self.pool.values
        lowest, middle = float(values.min()), float(values.median())
        if middle > lowest:  # what is out of all proportion, such as a penalty, says no more than that it is high
            values = values.clamp(max=lowest + _PROPORTION * (middle - lowest))
        spread = float(values.max()) - lowest or 1.0
        values = (values - lowest) / spread  # their squares do not overflow
        process = self._fit(values[:, None])
        if self._noisy:
            values = process.predict(self.pool.points)[:, 0]
            self._judge(values * spread + lowest)
        return process, self._lowest(LossModel(process, values.min()[None], torch.sum, torch.Size([1]), _EXPLORING))

    def _fit(self, outputs: Tensor) -> GaussianProcess:
        """Return the process of outputs [P, m]; where it ceases to find noise, what was evaluated counts again.

        Where an output was not finite it is taken to be as that with the highest loss. A loss alone says too little to
        tell noise from ripples: it is noisy if `noise` says so.
        """
        worst = outputs[int(self.pool.values.argmax())]
        points = torch.cat([self.pool.points, self._holes])
        outputs = torch.cat([outputs, worst.expand(len(self._holes), -1)])
        enough = min(_TELLING * (self.n + 1), self.pool.capacity)
        tells = self.noise > 0.0 or (self.loss is not None and len(self.pool) >= enough)
        process = GaussianProcess.fit(points, outputs, NOISES + HIGH_NOISES if tells else NOISES)
        before, self._noisy = self._noisy, self.noise > 0.0 or process.noise >= HIGH_NOISES[0]
        if before and not self._noisy:
            self.best, self.lowest, self.best_sigma = self._record
        return process

    def _judge(self, values: Tensor) -> None:
        """Make the point of the pool with the lowest of values [P] the best one."""
        k = int(values.argmin())
        if math.isfinite(values[k]):
            self.best, self.lowest = self.pool.points[k], float(values[k])
            self.best_sigma = max(self.sigma, self.tolerance)

    def _lowest(self, model: "LossModel") -> Tensor:
        """Return the best of candidates around the best point and all over the box, improved by ever smaller steps."""
        near = [self.best + scale * self._normal(_CANDIDATES, self.n) for scale in _SCALES]
        candidates = torch.cat([*near, self._uniform(4 * _CANDIDATES)]).clamp(self.lower, self.upper)
        scores = model(candidates)
        k, width = int(scores.argmin()), 0.3
        x, score = candidates[k], float(scores[k])
        for _ in range(_REFINEMENTS):
            candidates = (x + width * self._normal(2 * _CANDIDATES, self.n)).clamp(self.lower, self.upper)
            scores = model(candidates)
            k = int(scores.argmin())
            if float(scores[k]) < score:
                x, score = candidates[k], float(scores[k])
            else:
                width *= 0.4
        return x

    def _uniform(self, count: int) -> Tensor:
        return uniform(self.generator, self.lower, self.upper, count)

    def _normal(self, *shape: int) -> Tensor:
        return normal(self.generator, self.lower, *shape)


class LossModel:
    """Optimistic loss of predicted outputs, from a quadratic expansion of the loss around one output [m].

    An output that is off by s standard deviations v^1/2 in its worst direction has the loss
    L - s |grad L| (m v)^1/2 + s^2 tr(L'') v / 2, for a mean square (L^1/2 - s v^1/2)^2.
    """

    def __init__(
        self,
        process: GaussianProcess,
        output: Tensor,
        loss: Callable[[Tensor], Tensor],
        shape: torch.Size,
        optimism: float,
    ) -> None:
        self.process, self.optimism, m = process, optimism, len(output)
        directions = torch.cat([(process.mean - output)[None], process.weights])
        self.value, slope, bend = loss_derivatives(loss, output.view(shape), directions.view(-1, *shape))
        self.slope, self.bend = directions @ slope, directions @ bend.mT
        self.steepness = float(slope.square().sum()), bend @ slope, bend @ bend.mT
        self.elements = m
        size = float(directions.square().sum())
        self.trace = m * max(float(self.bend.diagonal().sum()), 0.0) / size if size > 0.0 else 0.0

    def __call__(self, x: Tensor) -> Tensor:
        """Optimistic losses [Q] of points [Q, n]."""
        covariance = self.process.covariance(x)
        c = torch.cat([covariance.new_ones(len(x), 1), covariance], 1)
        variance = self.process.uncertainty(covariance)
        constant, linear, square = self.steepness
        steepness = (constant + 2.0 * c @ linear + ((c @ square) * c).sum(1)).clamp_min(0.0).sqrt()
        # No prediction lies below the lowest value of the loss along the way: the parabola is cut at its vertex.
        reach = self.optimism * variance.sqrt() * math.sqrt(self.elements)
        if self.trace > 0.0:
            reach = torch.minimum(reach, steepness * self.elements / self.trace)
        return self._loss(c) - reach * steepness + 0.5 * self.trace / self.elements * reach.square()

    def is_true(self, x: Tensor, loss: float) -> bool:
        """Whether the expansion predicts the loss of the prediction at x [n]."""
        c = torch.cat([x.new_ones(1, 1), self.process.covariance(x[None])], 1)
        return abs(float(self._loss(c)[0]) - loss) <= 0.1 * abs(loss - self.value) + 1e-12 * abs(loss)

    def _loss(self, c: Tensor) -> Tensor:
        return self.value + c @ self.slope + 0.5 * ((c @ self.bend) * c).sum(1)
