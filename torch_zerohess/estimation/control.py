"""A surrogate as a control variate: its predictions for the points of a batch, through the head.

The surrogate and the coefficient come from earlier calls. They do not change during a call.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.estimation.head import apply_head
from torch_zerohess.estimation.outer import Outer
from torch_zerohess.heads import SquaredError
from torch_zerohess.surrogates.memory import Memory


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

    @classmethod
    def of(cls, memory: Memory, outer: Outer, *, learning: bool) -> "Control":
        """Return the control variate for a call that begins: the surrogate is fitted if that is due."""
        if learning:
            memory.refresh()
        c = outer.share(memory.coefficient if memory.ready else 0.0)
        if memory.fresh == 0 and not memory.ready:
            raise ValueError("memory with fresh=0 has no surrogate yet: add evaluations and call memory.fit()")
        return cls(memory, outer, c > 0.0, c, learning)

    def parted(self, aux: Sequence[Tensor]) -> tuple[Sequence[Tensor], Tensor | None]:
        """Return the auxiliary inputs of the head, and the scales [B, 2] after them where the surrogate gave some."""
        return (aux[:-1], aux[-1]) if self.active and not self.outer.linear else (aux, None)

    def explain(
        self,
        values: Tensor,
        points: Tensor,
        outputs: Tensor,
        aux: Sequence[Tensor],
        added: Callable[[Tensor], list[Tensor]],
        kept: Tensor | None,
    ) -> Tensor | None:
        """Keep new evaluations and return their predictions by the surrogate, float64 [B, E, *out], if it is used.

        Args:
            values: [B, E, *out].
            points: [B, E, n].
            outputs: of the black box [B, E, *outputs].
            aux: of the head [B, ...].
            added: what values [B, E, *out] add to the derivatives of the estimate, by order.
            kept: which values were not left out [B, E]; all of them if None.
        """
        predicted = None
        if self.memory.ready:
            with torch.no_grad():  # a module has parameters that require grad
                predicted = self.predictor(self.memory.surrogate, aux)(points).double()
            if predicted.shape != values.shape:
                raise ValueError(
                    f"the surrogate of the memory must return [K, {_listed(outputs.shape[2:])}] like the black box, "
                    f"got a prediction of {list(predicted.shape)} for values of {list(values.shape)}"
                )
            if self.active and not bool(torch.isfinite(predicted).all()):
                raise ValueError("the surrogate of the memory predicted a value that is not finite")
        if self.learning:
            if predicted is not None:
                derivatives = list(zip(added(values), added(predicted), strict=True))
                self.memory.observe(values, predicted, derivatives, kept)
            self.memory.add(points.flatten(0, 1), outputs.flatten(0, 1))
        return predicted if self.active else None

    def predictor(self, surrogate: Any, aux: Sequence[Tensor]) -> Callable[[Tensor], Tensor]:
        """Return h(g(z), r) as a function of points z [B, E, n] with values [B, E, *out], differentiable in z.

        Args:
            surrogate: g, of the memory or a copy.
            aux: r, [B, ...] each.
        """
        head = self.outer.head
        space = getattr(surrogate, "space", None)
        if isinstance(head, SquaredError) and space is not None:
            head.check(space.shape, aux[0])
            known, outside = space.split(aux[0])

            def squared(z: Tensor) -> Tensor:
                coordinates: Tensor = surrogate.coordinates(z.flatten(0, 1)).unflatten(0, z.shape[:2])
                return (coordinates - known[:, None]).square().sum(2) + outside[:, None]

            return squared

        def predict(z: Tensor) -> Tensor:
            outputs: Tensor = surrogate(z.flatten(0, 1))
            if self.memory.scalar and outputs.shape[1:] == (1,):
                outputs = outputs[:, 0]
            outputs = outputs.unflatten(0, z.shape[:2])
            return outputs if head is None else apply_head(head, outputs, aux)

        return predict


def _listed(shape: Sequence[int]) -> str:
    return ", ".join(map(str, shape))
