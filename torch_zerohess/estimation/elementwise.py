"""Optimal sampling: every element of value, gradient and Hessian has its own samples, with weights of one magnitude."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from torch_zerohess.estimation.skewness import Shape, shape_of
from torch_zerohess.estimation.stein import FIRST_ORDER_ERROR, Layout, Projection, Quantity, Spread, Stein, completed
from torch_zerohess.sampling import kernels, proposals, samplers
from torch_zerohess.sampling.proposals import DIAGONAL_LOBE, GRADIENT_LOBE, NORMAL, OFF_DIAGONAL_LOBE
from torch_zerohess.smoothing import Smoothing

_MOST_OPTIMAL = 1_000_000
"""Evaluations beyond which a batch is refused: their number grows with the square of n."""


@dataclass(frozen=True)
class Elementwise(Stein):
    """Proposal "optimal"."""

    weight: Tensor
    """[B, K]: the signed constant of a row's own element, times the number of sets, so that sums over K are means."""
    rows: Tensor
    """int64 [K, 5]; columns 2 to 4 are the kind of element and its dimensions i <= j."""
    n: int
    order: int

    droppable = False

    @classmethod
    def draw(
        cls, x: Tensor, sigma: Tensor, smoothing: Smoothing, seed: int, keep: bool, center: bool = False
    ) -> tuple[Tensor, "Elementwise"]:
        """See `Stein.draw`; ValueError if more than a million evaluations would be needed."""
        B, n = x.shape
        evaluations = B * smoothing.evaluations(n, center=False)
        if evaluations > _MOST_OPTIMAL:
            raise ValueError(
                f"proposal 'optimal' would need {evaluations} evaluations for {B} x {n} parameters and samples="
                f"{smoothing.samples}, at most {_MOST_OPTIMAL} are allowed: use proposal 'aggregate'"
            )
        elements = proposals.element_rows(seed, 0, smoothing.samples, n, smoothing.order).to(x.device)
        rows = elements.repeat(B, 1)
        rows[:, 1] = torch.arange(len(rows), device=x.device)
        points, u, _ = kernels.place(
            samplers.of_elements(rows, n, smoothing),
            x.double().contiguous(),
            sigma,
            smoothing.paired,
            x.dtype == torch.float32,
            proposals.GAUSSIAN,
        )
        elements = elements.repeat(1 + smoothing.paired, 1)
        weight = proposals.element_weights(u, elements) * smoothing.groups(n)
        return completed(points, x, center), cls(weight, elements, n, smoothing.order)

    @classmethod
    def layout(cls, smoothing: Smoothing, B: int, K: int, n: int, keep: bool) -> list[Layout]:
        return [Layout((B, K)), Layout((K, 5), torch.int64, batched=False)]

    def tensors(self) -> list[Tensor]:
        """Weights and rows."""
        return [self.weight, self.rows]

    @classmethod
    def rebuild(
        cls, tensors: Sequence[Tensor], x: Tensor, sigma: Tensor, smoothing: Smoothing, keep: bool
    ) -> "Elementwise":
        weight, rows = tensors
        return cls(weight, rows, x.shape[1], smoothing.order)

    @property
    def highest(self) -> int:
        return self.order

    def value(self, a: Tensor) -> Tensor:
        return (a * self.weight[:, None])[..., self.rows[:, 2] == NORMAL].sum(2)

    def gradient(self, a: Tensor) -> Tensor:
        chosen = self.rows[:, 2] == GRADIENT_LOBE
        return self._sums(a, chosen, self.rows[chosen, 3], self.n)

    def hvp(self, a: Tensor, v: Tensor) -> Tensor:
        return (self.hessian(a) @ v[..., None])[..., 0]

    def hessian_diagonal(self, a: Tensor) -> Tensor:
        return self.hessian(a).diagonal(dim1=2, dim2=3)

    def hessian(self, a: Tensor) -> Tensor:
        if self.first_order:
            raise ValueError(FIRST_ORDER_ERROR)
        chosen = (self.rows[:, 2] == DIAGONAL_LOBE) | (self.rows[:, 2] == OFF_DIAGONAL_LOBE)
        i, j = self.rows[chosen, 3], self.rows[chosen, 4]
        row, column = torch.triu_indices(self.n, self.n, device=a.device)
        upper = a.new_zeros(*a.shape[:2], self.n * self.n)
        sums = self._sums(a, chosen, i * self.n + j, len(row))
        upper = upper.index_copy(2, row * self.n + column, sums).unflatten(2, (self.n, self.n))
        return upper + upper.triu(1).mT

    def _sums(self, a: Tensor, chosen: Tensor, element: Tensor, count: int) -> Tensor:
        """Return the sums of the chosen rows of each element, [B, M, count]; all have as many rows.

        `index_add_` would add them in another order each time on a CUDA device.
        """
        terms = (a * self.weight[:, None])[..., chosen][..., element.argsort(stable=True)]
        return terms.reshape(*terms.shape[:2], count, len(element) // count).sum(3)

    def ratio(self, d: Tensor, project: Projection) -> Tensor:
        """Return the quadratic in d [B, n] whose derivatives are the kernels, [B, K]."""
        kind, i, j = self.rows[:, 2], self.rows[:, 3], self.rows[:, 4]
        d_i, d_j = (d.gather(1, index.expand(len(d), -1)) for index in (i, j))  # its backward has a vmap rule
        hessian = torch.where(kind == DIAGONAL_LOBE, 0.5, 1.0) * d_i * d_j
        factor = torch.where(kind == NORMAL, 1.0, torch.where(kind == GRADIENT_LOBE, d_i, hessian))
        return self.weight * factor

    def smoothed(self, values: Tensor, baseline: Tensor, a: Tensor) -> Tensor:
        """Only the rows of the value estimate F(x): the mean of the others differs from it."""
        return self.value(values.double().mT / values.shape[1])

    def variance(
        self,
        quantity: Quantity,
        a: Tensor,
        share: Tensor,
        draws: Sequence[Tensor],
        v: Tensor | None,
        pooled: Tensor | None = None,
    ) -> Spread:
        """Spread of the S draws of each element, which are the only ones that estimate it: S - 1 degrees of freedom.

        The hvp is a sum of elements with their own variances; its degrees are by Welch and Satterthwaite. Raises
        ValueError if an element has one draw.
        """
        if quantity not in ("value", "gradient") and self.first_order:
            raise ValueError(FIRST_ORDER_ERROR)
        index = draws[0].to(a.device)
        groups = 1 + self.n + (0 if self.first_order else self.n * (self.n + 1) // 2)
        S = len(index) // groups
        if S < 2:
            raise ValueError(
                "a standard error of proposal 'optimal' needs at least 2 independent draws per element, got 1: use at "
                "least 2 samples, with sampler 'sobol' an even number and scrambles None or at least 2"
            )
        # The value of a draw is f itself: relative to the mean of the others, draws would seem to be further apart.
        used = pooled if quantity == "value" and pooled is not None else a
        y = (used * self.weight[:, None])[:, :, index].sum(3).unflatten(2, (groups, S))
        deviations = y - y.mean(3, keepdim=True)
        squares = (deviations**2).sum(3)
        shape = shape_of(squares, (deviations**3).sum(3), (deviations**4).sum(3), squares.new_tensor(S))
        elements = squares * (S / (S - 1))
        if quantity == "hvp" and v is not None:
            return _of_products(self._matrix(elements), Shape(*map(self._matrix, shape)), v, S)
        chosen: Callable[[Tensor], Tensor] = {
            "value": lambda each: each[:, :, 0],
            "gradient": lambda each: each[:, :, 1 : 1 + self.n],
            "hessian": self._matrix,
            "hessian_diagonal": lambda each: self._matrix(each).diagonal(dim1=2, dim2=3),
        }[quantity]
        result = chosen(elements)
        return Spread(result, torch.full_like(result, S - 1), Shape(*map(chosen, shape)))

    def _matrix(self, each: Tensor) -> Tensor:
        """Return what belongs to the sets of the Hessian, of [B, P, groups], as symmetric matrices [B, P, n, n]."""
        i, j = torch.triu_indices(self.n, self.n, device=each.device)
        matrix = each.new_zeros(*each.shape[:2], self.n, self.n)
        matrix[:, :, i, j] = matrix[:, :, j, i] = each[:, :, 1 + self.n :]
        return matrix


def _of_products(variance: Tensor, shape: Shape, v: Tensor, S: int) -> Spread:
    """Return the spread of the hvp [B, P, n], whose terms H_ij v_j are independent, from the spread of H."""
    terms = variance * (v * v)[:, :, None]
    result, squares = terms.sum(3), (terms**2).sum(3)
    ratio = (terms / torch.where(result > 0, result, 1.0)[..., None]).sqrt() * v.sign()[:, :, None]
    parts = shape.scaled(ratio)
    degrees = torch.where(squares > 0, result**2 / squares, 1.0) * (S - 1)
    return Spread(result, degrees, Shape(parts.skewness.sum(3), parts.excess.sum(3)))
