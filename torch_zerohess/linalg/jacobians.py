"""Jacobians of many parameters, as the products that a system of few outputs needs.

A row of J is the gradient of one output of one sample. Where a weight of a linear layer is used once per sample, its
part of the row is the outer product of two vectors, the slope at the output of the layer and its input. Products from
these vectors need no memory for J: a weight [256, 1 024], 16 samples and 5 outputs take 84 MB as rows of J in float32,
and 147 kB as vectors.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor


class Jacobian(Protocol):
    """J [M, N] of M outputs by N parameters. Vectors may have another precision than J."""

    @property
    def outputs(self) -> int:
        """M."""
        ...

    def gram(self) -> Tensor:
        """Return J J^T [M, M]."""
        ...

    def rmatvec(self, w: Tensor) -> Tensor:
        """Return J^T w [N] for w [M]."""
        ...

    def matvec(self, v: Tensor) -> Tensor:
        """Return J v [M] for v [N]."""
        ...

    def dense(self) -> Tensor:
        """Return J [M, N]."""
        ...

    def joined(self, join: Callable[[Tensor], Tensor]) -> "Jacobian":
        """Return J with more samples: `join` adds them to a tensor, along its first dimension."""
        ...

    @property
    def layout(self) -> str:
        """Of what it is made, and its sizes but for the samples: Jacobians to be joined have the same."""
        ...


@dataclass(frozen=True)
class Rows:
    """A Jacobian that is formed."""

    rows: Tensor
    """[M, N]"""

    @property
    def outputs(self) -> int:
        return len(self.rows)

    def gram(self) -> Tensor:
        return self.rows @ self.rows.mT

    def rmatvec(self, w: Tensor) -> Tensor:
        return self.rows.mT @ w.to(self.rows)

    def matvec(self, v: Tensor) -> Tensor:
        return self.rows @ v.to(self.rows)

    def dense(self) -> Tensor:
        return self.rows

    def joined(self, join: Callable[[Tensor], Tensor]) -> "Rows":
        return Rows(join(self.rows))

    @property
    def layout(self) -> str:
        return f"rows {list(self.rows.shape[1:])} {self.rows.dtype}"


@dataclass(frozen=True)
class OuterProducts:
    """The Jacobian of n outputs of B samples by a weight [p, q] of which each sample has one product with its input."""

    slopes: Tensor
    """Of the outputs at the result of the product [B, n, p]."""
    inputs: Tensor
    """[B, q]"""

    @property
    def outputs(self) -> int:
        return self.slopes.shape[:2].numel()

    def gram(self) -> Tensor:
        flat = self.slopes.flatten(0, 1)
        n = self.slopes.shape[1]
        of_inputs = (self.inputs @ self.inputs.mT).repeat_interleave(n, 0).repeat_interleave(n, 1)
        return (flat @ flat.mT) * of_inputs

    def rmatvec(self, w: Tensor) -> Tensor:
        slopes = (w.to(self.slopes).view(*self.slopes.shape[:2], 1) * self.slopes).sum(1)
        return (slopes.mT @ self.inputs).reshape(-1)

    def matvec(self, v: Tensor) -> Tensor:
        moved = self.inputs @ v.to(self.inputs).view(self.slopes.shape[2], -1).mT
        return torch.einsum("bp,bnp->bn", moved, self.slopes).reshape(-1)

    def dense(self) -> Tensor:
        return torch.einsum("bnp,bq->bnpq", self.slopes, self.inputs).flatten(2).flatten(0, 1)

    def joined(self, join: Callable[[Tensor], Tensor]) -> "OuterProducts":
        return OuterProducts(join(self.slopes), join(self.inputs))

    @property
    def layout(self) -> str:
        return f"products {list(self.slopes.shape[1:])} {list(self.inputs.shape[1:])} {self.slopes.dtype}"


@dataclass(frozen=True)
class Blocks:
    """Jacobians by some parameters each, side by side."""

    parts: Sequence[Jacobian]
    sizes: Sequence[int]
    """Parameters of each."""

    @property
    def outputs(self) -> int:
        return self.parts[0].outputs

    def gram(self) -> Tensor:
        return torch.stack([one.gram() for one in self.parts]).sum(0)

    def rmatvec(self, w: Tensor) -> Tensor:
        return torch.cat([one.rmatvec(w) for one in self.parts])

    def matvec(self, v: Tensor) -> Tensor:
        moved = [one.matvec(part) for one, part in zip(self.parts, v.split(list(self.sizes)), strict=True)]
        return torch.stack(moved).sum(0)

    def dense(self) -> Tensor:
        return torch.cat([one.dense() for one in self.parts], 1)

    def joined(self, join: Callable[[Tensor], Tensor]) -> "Blocks":
        return Blocks([one.joined(join) for one in self.parts], self.sizes)

    @property
    def layout(self) -> str:
        return ", ".join(one.layout for one in self.parts)
