"""The Jacobian of an output whose elements depend on few parameters each: `keep` entries per element."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torch_zerohess.surrogates.sparse_product import SparseRows, product
from torch_zerohess.surrogates.surrogate import outside_inference


@dataclass(frozen=True, eq=False)
class SparseJacobian:
    """The `keep` largest entries of every row of a Jacobian [*out, n], in the type of `values`.

    m is the number of elements of the output. An entry that is not used has the value 0 and the standard error 0.

    Example:
        >>> index, values = torch.tensor([[0, 3], [2, 0]]), torch.tensor([[1.0, 2.0], [5.0, 0.0]])
        >>> J = SparseJacobian(index, values, torch.zeros(2, 2), 4, torch.Size([2]))
        >>> J.matvec(torch.ones(4)).tolist(), J.rmatvec(torch.ones(2)).tolist()
        ([3.0, 5.0], [1.0, 0.0, 5.0, 2.0])
        >>> J.untouched.tolist()
        [False, True, False, False]
    """

    index: Tensor
    """Parameters [m, keep], int64."""
    values: Tensor
    """Slopes [m, keep]."""
    standard_error: Tensor
    """Of the slopes [m, keep], also where the variance of a sample depends on its perturbation. The support is taken
    as given: an entry that was not found has no error here."""
    n: int
    """Parameters."""
    shape: torch.Size
    """Of the output, [*out]."""
    explained: float = 0.0
    """Share of the change of held-out outputs that is predicted: 1 is all of it, 0 or less is nothing."""
    explained_dense: float = 0.0
    """The same for the Jacobian of least norm, which has n entries per row, from the same samples. A search measures it
    with its first Jacobian, and keeps that share."""
    evaluations: int = 0
    """Of the black box, for this Jacobian."""
    total_evaluations: int = 0
    """For this Jacobian and the earlier ones that it began with."""
    _entries: tuple[SparseRows, SparseRows] = field(init=False, repr=False)
    """The entries that are used, by rows and by columns."""

    def __post_init__(self) -> None:
        # Not when they are first needed: what is computed inside of a transform of torch.func cannot be used after it.
        with outside_inference():
            found = self.found
            row, column, values = found.nonzero()[:, 0], self.index[found], self.values[found]
            counts = found.sum(1)
            by_rows = SparseRows(column, counts.cumsum(0) - counts, values)
            object.__setattr__(self, "_entries", (by_rows, SparseRows.of(column, row, values, self.n)))

    @classmethod
    def empty(cls, n: int, shape: Sequence[int], keep: int, like: Tensor) -> "SparseJacobian":
        """Return a Jacobian without entries, in the type and on the device of `like`."""
        size = torch.Size(shape)
        none = like.new_zeros(size.numel(), keep)
        return cls(none.long(), none, none.clone(), n, size)

    def to(self, like: Tensor) -> "SparseJacobian":
        """Return the same in the type and on the device of `like`."""
        return replace(
            self,
            index=self.index.to(like.device),
            values=self.values.to(like),
            standard_error=self.standard_error.to(like),
        )

    def times(self, factors: Tensor | float) -> "SparseJacobian":
        """Return the Jacobian with its columns multiplied by factors [n], or by one factor."""
        if isinstance(factors, Tensor):
            factors = factors[self.index]
        elif factors == 1.0:
            return self
        return replace(self, values=self.values * factors, standard_error=self.standard_error * factors)

    def within(self, parameters: Tensor) -> "SparseJacobian":
        """Return the Jacobian with the entries of some parameters alone, given as bools [n]."""
        return self if bool(parameters.all()) else self.times(parameters.to(self.values))

    @property
    def found(self) -> Tensor:
        """Which entries are used, [m, keep]."""
        return self.values != 0

    @property
    def entries(self) -> tuple[SparseRows, SparseRows]:
        """The entries that are used, by rows and by columns: for products without a graph, which take less time."""
        return self._entries

    @property
    def untouched(self) -> Tensor:
        """Which parameters no element of the output was found to depend on, [n]."""
        seen = torch.zeros(self.n, dtype=torch.bool, device=self.values.device)
        seen[self.index[self.found]] = True
        return ~seen

    def matvec(self, v: Tensor) -> Tensor:
        """Return J v [*batch, *out] for v [*batch, n], in the type of v, with derivatives in v."""
        batch, (rows, columns) = self._batch("v", v, torch.Size([self.n])), self._entries
        return product(rows, columns, v.reshape(-1, self.n)).reshape(*batch, *self.shape)

    def rmatvec(self, w: Tensor) -> Tensor:
        """Return J^T w [*batch, n] for w [*batch, *out], in the type of w, with derivatives in w."""
        batch, (rows, columns) = self._batch("w", w, self.shape), self._entries
        return product(columns, rows, w.reshape(-1, len(self.index))).reshape(*batch, self.n)

    @property
    def squared_lengths(self) -> Tensor:
        """Squared lengths of the columns, [n]."""
        columns = self._entries[1]
        return columns._replace(values=columns.values.square()).times(self.values.new_ones(1, len(self.values)))[0]

    def dense(self) -> Tensor:
        """Return the Jacobian as a tensor [*out, n], m n numbers."""
        whole = self.values.new_zeros(len(self.values), self.n)
        return whole.scatter_add_(1, self.index, self.values).view(*self.shape, self.n)

    def __repr__(self) -> str:
        left = int(self.untouched.sum())
        return (
            f"SparseJacobian(shape={[*self.shape, self.n]}, entries={int(self.found.sum())}, "
            f"explained={self.explained:.3g}, untouched={left} of {self.n} parameters)"
        )

    def _batch(self, name: str, vectors: Tensor, shape: torch.Size) -> torch.Size:
        """Return the dimensions before `shape`, or raise ValueError if the others are not `shape`."""
        if not isinstance(vectors, Tensor) or not vectors.is_floating_point():
            raise TypeError(f"{name} must be a real floating tensor, got {getattr(vectors, 'dtype', type(vectors))}")
        first = len(vectors.shape) - len(shape)
        if first < 0 or vectors.shape[first:] != shape:
            wanted = ", ".join(map(str, ["*batch", *shape]))
            raise ValueError(f"{name} must have shape [{wanted}], got {list(vectors.shape)}")
        return vectors.shape[:first]
