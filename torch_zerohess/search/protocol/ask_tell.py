"""Ask and tell, the same for every search: the checks, the values told, and the state that is saved.

A search is a `Method` inside an `AskTell`. `tell` makes the whole next `State` and assigns it at the end. So a search
is as it was if anything raises. `ask` reads the state, and notes which points it has given out: their number does not
tell them, because the further points of a batch depend on its size, and a limit cuts it. Points that were given out
stay valid until values are told, whatever is asked for after them.

To add a search: a subclass of `Progress` with its fields, a subclass of `Method` with its step, and a subclass of
`AskTell` that makes the method.
"""

from __future__ import annotations  # signatures print names of types, not what they stand for

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.arguments import check_state, checked_integer, checked_number, checked_seed
from torch_zerohess.search.protocol.method import Method, Settings
from torch_zerohess.search.protocol.reference import Reference, reference
from torch_zerohess.search.protocol.replaced import replace
from torch_zerohess.search.protocol.space import Bounds, Space, Vector, checked_start
from torch_zerohess.search.protocol.standing import Standing
from torch_zerohess.search.protocol.state import Evaluated, P, State, plain, restored, restored_progress
from torch_zerohess.search.protocol.told_values import as_evaluated, check_start, converted, joined
from torch_zerohess.search.protocol.white_box import checked_loss
from torch_zerohess.smoothing import random_seed
from torch_zerohess.threads import one_thread
from torch_zerohess.version import VERSION


class AskTell(Standing[P]):
    """A search whose evaluations the caller owns: `ask` for points, evaluate them, `tell` their values.

    Args:
        x0: start [n], within the bounds: a tensor, a NumPy array, a list or a tuple. float16 and bfloat16 become
            float32, integers float64.
        sigma: smoothing at the start, in units of the parameters: of the order of the distance to the solution.
            One value, or one per parameter [n] where they have different units; at most the width of its bounds.
        bounds: lower and upper, numbers or [n], None for no bound on a side; or a list of n pairs; or
            `scipy.optimize.Bounds`. No point outside of them is ever asked for.
        loss: from one output [*out], float64 on the device of x0, to a scalar, differentiable by torch: `.double()`
            networks in it. None if the black box returns the loss.
        restarts: how often to go on after the search has arrived at a minimum. 0 for a local search.
        tolerance: length, in units of the first sigma, below which the search has arrived.
        noise: standard deviation of repeated losses at one point, if it is known.
        pool: evaluations kept; a default by the number of parameters if None.
        seed: of the samples; from torch's global generator if None. The same seed gives the same bits with the same
            number of threads of torch.

    Raises ValueError for settings out of range, TypeError for settings of another type.
    """

    def __init__(
        self,
        x0: Vector,
        *,
        sigma: float | Vector,
        bounds: Bounds | None = None,
        loss: Callable[[Tensor], Tensor] | None = None,
        restarts: int = 10,
        tolerance: float = 1e-2,
        noise: float = 0.0,
        pool: int | None = None,
        seed: int | None = None,
    ) -> None:
        x0 = checked_start(x0)
        white_box = checked_loss(loss)
        restarts = checked_integer("restarts", restarts, 0)
        pool = None if pool is None else checked_integer("pool", pool, 4)
        if not 0 <= checked_number("noise", noise) < math.inf:
            raise ValueError(f"noise must be finite and at least 0, got {noise}")
        checked_number("tolerance", tolerance, above=0.0, below=1.0)
        self.seed = random_seed() if seed is None else checked_seed(seed)
        """Of the samples; after `load_state_dict` it is the one of the saved search."""
        self._space = space = Space.checked(x0, sigma, bounds)
        start, lower, upper = (space.coordinates(one) for one in (space.start, space.lower, space.upper))
        self._method = self._make(Settings(start, lower, upper, white_box, restarts, tolerance, float(noise), pool))
        generator = torch.Generator().manual_seed(self.seed)
        self._state = self._after(*self._method.first(generator), generator)
        self._out: Tensor | None = self._state.asked[:0]
        """Points given out last [K, n], None if `load_state_dict` does not know."""
        self._asked: dict[int, Tensor] = {}
        """Points that `ask` has returned since the last values were told [K, n], by K."""
        self._early: dict[int, Tensor] = {}
        """Values of some of them, by number, that came before the others."""
        self._drawn: tuple[int, Tensor] | None = None
        """The batch that `ask` drew points for last, and these points, so that no model is fitted twice."""
        self.told = torch.empty(0, dtype=torch.float64, device=x0.device)
        """Losses [K] of the points told last; none after `load_state_dict`."""
        self.reference: Reference | None = None
        """Outputs by which `load_state_dict` knows the loss."""

    @abstractmethod
    def _make(self, settings: Settings) -> Method[P]:
        """Return the method that searches with these settings. ValueError if it cannot."""

    def ask(self, batch: int = 1, *, limit: int | None = None) -> Tensor:
        """Return the next points to evaluate [K, n]; the same ones until they are told.

        K may be larger than the batch. The first points are the start and its samples, up to n + 1 of them in most
        searches, and a later step may take several points, too. Evaluate as many of them at once as you can, and tell
        each value when it is there: `tell(value, which=[k])`. Once some of their values are told, these are the points
        whatever the batch.

        Args:
            batch: how many evaluations can run at once. If the search itself has fewer points to ask for, others are
                added that are most informative beside them. They save rounds, not evaluations. `LocalGaussNewton` and
                `BlockGaussNewton` add none.
            limit: how many points there may be at most. The step is then taken without the others, and is a worse one:
                it is for the last evaluations that there are.

        ValueError for a batch or limit below 1, RuntimeError if the search is done.
        """
        batch = checked_integer("batch", batch, 1)
        limit = None if limit is None else checked_integer("limit", limit, 1)
        if self.done:
            raise RuntimeError(f"the search is done: {self.message}")
        if self._early:
            points = self._given
        else:
            if self._drawn is None or self._drawn[0] != batch:
                self._drawn = batch, self._points(batch)
            points = self._drawn[1]
        self._out = points[:limit]
        self._asked[len(self._out)] = self._out
        return self._space.parameters(self._out)

    @property
    def missing(self) -> list[int]:
        """Numbers of the points, among those that `ask` returned, whose values are not told."""
        return [k for k in range(len(self._given)) if k not in self._early]

    def tell(self, values: Any, which: Sequence[int] | None = None) -> None:
        """Take the values of the points that `ask` returned: [K], or [K, *out] if there is a `loss`.

        With `which` [k], numbers of points, these are the values of some of them: [k] or [k, *out], in any order. The
        step is taken when the last one is told, and does not depend on the order. Without `which` they are the values
        of all points that are `missing`. They may also be the values of points that an earlier `ask` has returned, if
        the last one has returned another number of points. If a batch was asked for after `state_dict`, ask for it
        again after `load_state_dict` before telling parts of it.

        Points whose values are not finite are avoided. Raises ValueError for a wrong shape, or if the start itself has
        no finite value; TypeError or ValueError for a loss that is not a differentiable scalar; and whatever the loss
        raises, see `WhiteBox`. The search is then as before, and the same values can be told again.
        """
        values, points = converted(values, self.unit.device), self._given
        count = len(values) if values.ndim else 1
        if which is None and not self._early:
            points = self._asked.get(count, points)
        if self._out is None and which is None and not self._early:
            points = self._points(count)[:count]
        if not len(points):
            raise RuntimeError("ask for points before telling their values")
        if which is not None or self._early:
            early = joined(self._early, values, self.missing if which is None else which, len(points))
            if 0 in early.keys() - self._early.keys() and not self.evaluations:
                check_start(self._evaluated(early[0][None], points[:1]))
            if not early.keys() >= set(range(len(points))):
                self._out, self._early = points, early
                return
            values = torch.stack([early[k] for k in range(len(points))])
        self._take(values, points)

    def tell_at(self, values: Any, points: Any) -> None:
        """Take values of points [K, n] that the caller has evaluated already; before any `tell`.

        The search begins with a model of them, and takes fewer evaluations. Points are a tensor, an array or a list, in
        any order. One of them is the start x0: make the search at the best of them. Otherwise as `tell`. RuntimeError
        if values have been told; ValueError for points that are not finite, not within the bounds, or without x0.
        """
        if self.evaluations or self._early:
            raise RuntimeError("values have been told: points of one's own come before")
        values, points = converted(values, self.unit.device), self._space.checked_points(points)
        if values.ndim and len(values) == len(points):  # otherwise what follows says what is wrong
            order = self._space.start_first(points)
            values, points = values[order], points[order]
        self._take(values, self._space.coordinates(points))

    def _take(self, values: Tensor, points: Tensor) -> None:
        """Take a step with the values [K, *out] of points [K, n], in units of sigma."""
        evaluated = self._evaluated(values, points)
        if not self.evaluations:
            check_start(evaluated)
        generator = torch.Generator()
        generator.set_state(self._state.random)
        with one_thread(len(self.unit), values.shape[1:].numel()):
            self._state = self._after(*self._method.after(self._state.progress, evaluated, generator), generator)
        self._out, self._asked, self._early, self._drawn = points[:0], {}, {}, None
        self.told = evaluated.usable
        self.reference = reference(self.reference, evaluated)

    def losses(self, values: Any) -> Tensor:
        """Return the losses [K] of what the black box has returned for K points, read and checked as by `tell`."""
        values = converted(values, self.unit.device)
        return self._evaluated(values, self.unit.expand(len(values) if values.ndim else 0, -1)).usable

    def state_dict(self) -> dict[str, Any]:
        """Everything that a search with the same settings needs to go on exactly as this one would.

        Tensors, numbers, strings, lists and dicts: `torch.save`, and `torch.load` with weights_only=True.
        """
        alone = len(self._given) in (0, len(self._state.asked))  # nothing is out, or what the search itself asked for
        out = {"early": dict(self._early), "out": None if alone else self._given, "version": VERSION}
        bounds = {"lower": self._space.lower, "upper": self._space.upper}
        own = {"search": self._kind, "unit": self.unit, **bounds, "seed": self.seed, "reference": plain(self.reference)}
        return {**own, **out, **plain(self._state)}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a `state_dict`; the settings stay those given here.

        ValueError for a state of another search, other parameters, sigma, bounds or loss. KeyError if something is
        missing. The loss is another one if the first or the lowest output of the saved search has another loss now. A
        loss that is random is not compared: one whose values of these outputs differ from call to call. What the loss
        raises passes, and the search is then as before.
        """
        check_state(state, self.state_dict(), "a search")
        if state["search"] != self._kind:
            raise ValueError(f"state must be of a search by {self._kind}, got one by {state['search']}")
        self._space.check_state(state)
        device = self.unit.device
        progress = restored_progress(self._method.progress, state, device)
        known = None if state["reference"] is None else restored(Reference, state["reference"], device)
        if known is not None and self.loss is not None:
            known.check(self.loss)
        early = {k: value.to(device) for k, value in state["early"].items()}
        out = None if state["out"] is None else state["out"].to(device)
        self._state = State(progress, state["asked"].to(device), state["random"].cpu())
        self.seed, self.reference, self.told = state["seed"], known, self.told[:0]
        self._out, self._asked, self._early, self._drawn = out, {}, early, None

    @property
    def _given(self) -> Tensor:
        """Points out for evaluation [K, n], as far as is known."""
        return self._state.asked if self._out is None else self._out

    @property
    def _kind(self) -> str:
        of = "the loss" if self._method.settings.loss is None else "the output"
        return f"{self._method.engine} of {of}{' in noise' if self._method.averages else ''}"

    def _after(self, progress: P, asked: Tensor, generator: torch.Generator) -> State[P]:
        return State(progress, self._space.rounded(asked), generator.get_state())

    def _points(self, batch: int) -> Tensor:
        """Return the points of the search [K, n], and further ones up to a batch. All come from the state."""
        points = self._state.asked
        if len(points) >= batch or self.done:
            return points
        generator = torch.Generator()
        generator.set_state(self._state.random)
        generator.manual_seed(int(torch.randint(2**63 - 1, (), generator=generator, device="cpu")))
        progress = self._state.progress
        with one_thread(len(self.unit), progress.shape.numel()):
            further = self._method.more(progress, points, batch - len(points), generator)
        return torch.cat([points, self._space.rounded(further)])

    def _evaluated(self, values: Tensor, points: Tensor) -> Evaluated:
        """Return what was told about points [K, n], of which those beyond the search's own are from `Method.more`."""
        found = as_evaluated(values, points, self._method.settings.loss, self._state.progress.shape)
        return replace(found, extra=max(len(points) - len(self._state.asked), 0))
