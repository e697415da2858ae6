"""A surrogate as a control variate: its predictions for the points of a batch, through the head.

The surrogate and the coefficient come from earlier calls. They do not change during a call.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.nn.parameter import is_lazy

from torch_zerohess.estimation.advice import add_note
from torch_zerohess.estimation.head import apply_head
from torch_zerohess.estimation.outer import Outer
from torch_zerohess.evaluation_mode import evaluation_mode
from torch_zerohess.heads import SquaredError
from torch_zerohess.precision import without_autocast
from torch_zerohess.surrogates.automatic import AutomaticSurrogate
from torch_zerohess.surrogates.gaussian_process_surrogate import ProcessSurrogate
from torch_zerohess.surrogates.linear import LinearSurrogate
from torch_zerohess.surrogates.low_rank import LowRank, LowRankSurrogate
from torch_zerohess.surrogates.memory import Memory
from torch_zerohess.surrogates.sparse_surrogate import SparseSurrogate
from torch_zerohess.surrogates.squared_distance import SquaredDistance

_WITH_COORDINATES = (AutomaticSurrogate, LowRankSurrogate)
"""Exact types: a subclass may predict anything, and a surrogate of the caller's may have a `space` of its own."""

_ROUNDING, _DEVIATION = 16.0, 0.01
"""Errors of values that are negligible: in units of their rounding, and of their deviation."""


NOT_FINITE = "the surrogate of the memory predicted a value that is not finite"
_LARGE = 256
"""Numbers of an output beyond which a head of the caller's takes most of the time of a prediction."""
_PLAIN = (torch.jit.ScriptModule, nn.DataParallel)
"""Modules whose parameters cannot be exchanged for a call."""
_changed = threading.RLock()
"""Held while a module has other parameters or another mode."""


@dataclass(frozen=True)
class Control:
    """The memory of a layer during one call."""

    memory: Memory
    outer: Outer
    active: bool
    """Whether the surrogate is subtracted; if not, evaluations are only kept."""
    coefficient: float
    """What the surrogate's values are multiplied by."""
    learning: bool
    """Whether evaluations are kept."""
    taken: int
    """Evaluations that the memory had taken when the call began. A fixed seed gives other samples as they grow: the
    surrogate knows the evaluations of earlier calls, and explains new evaluations at the same points too well."""

    @classmethod
    def of(cls, memory: Memory, outer: Outer, *, learning: bool) -> "Control":
        """Return the control variate for a call that begins: the surrogate is fitted if that is due."""
        if learning:
            memory.refresh()
        c = outer.share(memory.coefficient if memory.ready else 0.0)
        if memory.fresh == 0 and not memory.ready:
            raise ValueError("memory with fresh=0 has no surrogate yet: add evaluations and call memory.fit()")
        return cls(memory, outer, c > 0.0, c, learning, memory.evaluations)

    @property
    def costly(self) -> bool:
        """Whether a head of the caller's goes through all numbers of a large output."""
        head, shape = self.outer.head, self.memory.output_shape
        return head is not None and type(head) is not SquaredError and shape is not None and shape.numel() > _LARGE

    def parted(self, aux: Sequence[Tensor]) -> tuple[Sequence[Tensor], Sequence[Tensor], Tensor | None]:
        """Return the auxiliary inputs of the head, `Prediction.encoded` of them, and the scales [B, 2] if any.

        While the surrogate is active, the others come after the inputs of the head.
        """
        if not self.active:
            return aux, (), None
        aux, scales = (aux, None) if self.outer.linear else (aux[:-1], aux[-1])
        encoded = 2 if coordinates_of(self.memory.surrogate, self.outer) is not None else 0
        return aux[: len(aux) - encoded], aux[len(aux) - encoded :], scales

    def keep(self, points: Tensor, outputs: Tensor) -> None:
        """Add new evaluations, points [B, E, n] and outputs [B, E, *outputs], to the memory of a layer that learns."""
        if self.learning:
            self.memory.add(points.flatten(0, 1), outputs.flatten(0, 1))

    def explain(
        self,
        values: Tensor,
        points: Tensor,
        outputs: Tensor,
        aux: Sequence[Tensor],
        encoded: Sequence[Tensor],
        added: Callable[[Tensor], list[Tensor]],
        kept: Tensor | None,
    ) -> Tensor | None:
        """Return predictions of new evaluations by the surrogate, float64 [B, E, *out], if it is used.

        A layer that learns compares them with the values.

        Args:
            values: [B, E, *out].
            points: [B, E, n].
            outputs: of the black box [B, E, *outputs].
            aux: of the head [B, ...].
            encoded: of `Prediction` for these aux, if it is known.
            added: what values [B, E, *out] add to the derivatives of the estimate, by order.
            kept: which values were not left out [B, E]; all of them if None.
        """
        predicted = None
        if self.memory.ready:
            with torch.no_grad():  # a module has parameters that require grad
                predicted = Prediction(self, self.memory.surrogate, aux, encoded)(points).double()
            if self.active and not bool(torch.isfinite(predicted).all()):
                raise ValueError(NOT_FINITE)
        if self.learning and predicted is not None:
            least = [float(one.square().mean()) for one in added(_negligible(values, outputs.dtype))]
            derivatives = list(zip(added(values), added(predicted), least, strict=True))
            self.memory.regression.observe(values, predicted, derivatives, kept)
        return predicted if self.active else None


class Prediction:
    """h(g(z), r) as a function of points z [B, E, n] with values [B, E, *out], differentiable in z.

    Args:
        control: the head h.
        surrogate: g, of the memory or a copy.
        aux: r, [B, ...] each.
        encoded: `encoded` of an earlier prediction with the same surrogate and aux; empty: to be computed.
    """

    def __init__(self, control: Control, surrogate: Any, aux: Sequence[Tensor], encoded: Sequence[Tensor] = ()) -> None:
        self._surrogate, self._aux, self._head = surrogate, aux, control.outer.head
        self._shape = control.memory.output_shape
        if type(self._head) is SquaredError and len(aux) != 1:
            raise TypeError(
                f"aux must be the references alone, one tensor, for head SquaredError, got {len(aux)} tensors"
            )
        self.encoded = list(encoded)
        """Coordinates [B, r] of the references and the mean square [B] outside of them, where they have coordinates."""
        space = coordinates_of(surrogate, control.outer)
        if space is not None and not self.encoded:
            SquaredError.check(space.shape, aux[0])
            with without_autocast(aux[0].device):
                self.encoded = list(space.split(aux[0]))

    def __call__(self, z: Tensor) -> Tensor:
        if self.encoded:
            known, outside = self.encoded
            with without_autocast(z.device):
                coordinates: Tensor = self._surrogate.coordinates(z.flatten(0, 1)).unflatten(0, z.shape[:2])
            return (coordinates - known[:, None]).square().sum(2) + outside[:, None]
        outputs = self._outputs(z)
        return outputs if self._head is None else apply_head(self._head, outputs, self._aux)

    def check_head(self, x: Tensor) -> None:
        """Raise ValueError if the head has a tensor of its own that requires grad, for outputs at x [B, n].

        Where evaluations are made, they find it.
        """
        if self._head is not None and not self.encoded:
            with torch.no_grad():
                outputs = self._outputs(x[:, None])
            apply_head(self._head, outputs, self._aux)

    def _outputs(self, z: Tensor) -> Tensor:
        """Return the predictions [B, E, *out] at points z [B, E, n]."""
        with without_autocast(z.device):
            outputs: Tensor = as_constant(self._surrogate, z.flatten(0, 1))
        return self._checked(outputs, z.shape[:2].numel()).unflatten(0, z.shape[:2])

    def _checked(self, outputs: Tensor, count: int) -> Tensor:
        """Return predictions in the shape of the black box, [count, *out]; for one number [count, 1] is allowed, too.

        Raises ValueError for another shape.
        """
        shape = outputs.shape[1:] if self._shape is None else self._shape
        if shape == () and outputs.shape[1:] == (1,):
            outputs = outputs[:, 0]
        if outputs.shape != (count, *shape):
            raise ValueError(
                f"the surrogate of the memory must return {[count, *shape]} like the black box, "
                f"got {list(outputs.shape)}"
            )
        return outputs

    def squared_distance(self) -> SquaredDistance | None:
        """Return the losses in closed form, if they are squared errors of a Gaussian process."""
        model = self._model
        if type(self._head) is not SquaredError or type(model) is not ProcessSurrogate:
            return None
        if self.encoded:
            known, outside = self.encoded
            return SquaredDistance(model.process, model.lengths, known.double(), outside.double())
        (references,) = self._aux
        SquaredError.check(self._shape or (), references)
        flat = references.reshape(len(references), -1).double()
        root = flat.shape[1] ** -0.5  # the mean over the elements of an output
        process = replace(model.process, mean=root * model.process.mean, weights=root * model.process.weights)
        return SquaredDistance(process, model.lengths, root * flat, flat.new_zeros(len(flat)))

    @property
    def _model(self) -> Any:
        """The surrogate of coordinates or outputs: one of the caller's with a model in it may be anything."""
        return self._surrogate.model if type(self._surrogate) in _WITH_COORDINATES else self._surrogate

    def excess(self, sigma: Tensor) -> Tensor | None:
        """Return E h(g(z + sigma u), r) - h(g(z), r) where it is the same for all z and r, else None.

        It is for affine g and squared errors: the variance of an element of g(z + sigma u), as a mean over elements.
        """
        model = self._model
        if type(self._head) is not SquaredError or type(model) not in (LinearSurrogate, SparseSurrogate):
            return None
        whole = model.variance(sigma)
        return whole if self.encoded else whole / max(1, self._aux[0][0].numel())


def _negligible(values: Tensor, dtype: torch.dtype) -> Tensor:
    """Return errors [B, E] of random signs: rounding of values [B, E, *out], and a hundredth of their deviation."""
    generator = torch.Generator().manual_seed(0)
    signs = torch.randint(2, values.shape[:2], generator=generator, device="cpu").to(values.device) * 2.0 - 1.0
    every = values.reshape(*signs.shape, -1).double()
    deviation = (every - every.mean(1, keepdim=True)).square().mean((1, 2)).sqrt()
    size = _ROUNDING * torch.finfo(dtype).eps * every.abs().amax((1, 2)) + _DEVIATION * deviation
    return signs * size[:, None]


def as_constant(surrogate: Any, z: Tensor) -> Tensor:
    """Call a surrogate, a module in evaluation mode and without a graph to its parameters.

    They are constants of the estimate, and what is predicted for a point may not depend on the other points.
    """
    try:
        if not isinstance(surrogate, nn.Module):
            return surrogate(z)
        with _changed, evaluation_mode(surrogate):
            if not isinstance(surrogate, _PLAIN):
                named = dict(surrogate.named_parameters())
                if any(one.requires_grad for one in named.values()) and not any(map(is_lazy, named.values())):
                    return functional_call(surrogate, {name: one.detach() for name, one in named.items()}, (z,))
            return surrogate(z)
    except RuntimeError as error:
        if "data pointer" in str(error):  # NumPy got a tensor of a transform
            raise RuntimeError("the surrogate of the memory is not made of torch: torch.func cannot map it") from error
        add_note(error, f"the surrogate of the memory, {type(surrogate).__name__}, was called with points {[*z.shape]}")
        raise


def coordinates_of(surrogate: Any, outer: Outer) -> LowRank | None:
    """Return the coordinates in which a surrogate tells squared errors, if it has any and the head is one."""
    known = type(surrogate) in _WITH_COORDINATES and type(outer.head) is SquaredError
    space: LowRank | None = surrogate.space if known else None
    return space


def in_coordinates(surrogate: Any) -> Any:
    """Return a surrogate of the coordinates of outputs, of which there are few, or of the outputs themselves."""
    return surrogate.coordinates if type(surrogate) in _WITH_COORDINATES else surrogate
