"""The curvature of a batch of black boxes as one small matrix per element.

Behind a network, H = J^T A J with A = d2l/dy2 over the outputs y [*batch, n] of the network. Where the loss is a sum
over the batch, A is block-diagonal: one matrix [n, n] per element, which n products give for all elements at once.
"""

import torch
from torch import Tensor

from torch_zerohess.autograd.curvature import CurvatureOperator

_TOLERANCE = 1e-3
"""Relative error of the blocks against a product with A, and relative answer of elements to other ones, at which the
loss is not a sum over the batch."""


def output_blocks(operator: CurvatureOperator) -> list[Tensor]:
    """Return the blocks [B, n, n] of A, symmetric and float64, for every tensor y [*batch, n] of the operator.

    Raises ValueError if the loss couples elements of the batch, so that A is not block-diagonal.
    """
    through = operator.through
    blocks = []
    for index, y in enumerate(through):
        columns = []
        for i in range(y.shape[-1]):
            unit = [torch.zeros_like(one) for one in through]
            unit[index][..., i] = 1.0
            columns.append(operator.output_curvature(unit)[index].reshape(-1, y.shape[-1]))
        block = torch.stack(columns, 2).double()
        blocks.append(0.5 * (block + block.mT))
    _check(operator, blocks)
    return blocks


def _check(operator: CurvatureOperator, blocks: list[Tensor]) -> None:
    """Compare with a product of A with a vector of random numbers, another for every element."""
    generator = torch.Generator().manual_seed(0)
    vectors = [
        torch.rand(y.shape, generator=generator, dtype=torch.float32, device="cpu").to(y) for y in operator.through
    ]
    products = operator.output_curvature(vectors)
    error = size = 0.0
    for product, block, vector in zip(products, blocks, vectors, strict=True):
        expected = (block @ vector.reshape(len(block), -1, 1).double())[..., 0]
        error += float((product.reshape_as(expected).double() - expected).norm())
        size += float(block.norm())
    if error > _TOLERANCE * size and _answers(operator, vectors) > _TOLERANCE * size:
        raise ValueError(
            "modification and solver 'dual' need a loss that is a sum or mean over the batch of black boxes, but the "
            "loss couples its elements: use modification=None and solver 'steihaug' or 'clip'"
        )


def _answers(operator: CurvatureOperator, vectors: list[Tensor]) -> float:
    """Return how far elements of the batch answer to vectors of other ones: 0 if A is block-diagonal.

    Rounding changes products, too: in half precision, and where curvature is zero but for rounding. But it makes no
    element answer to another one. The elements are numbered. For each bit of the numbers, only elements with this bit
    have a vector, and the products at the elements without it are summed up. This finds every pair, because two numbers
    differ in some bit.
    """
    flat = [one.reshape(-1, one.shape[-1]) for one in vectors]
    counts = [len(one) for one in flat]
    total = 0.0
    for bit in range((sum(counts) - 1).bit_length()):
        moves = (torch.arange(sum(counts), device="cpu") >> bit & 1).bool().split(counts)
        moved = [
            torch.where(one.to(part.device)[:, None], part, 0.0).reshape(vector.shape)
            for one, part, vector in zip(moves, flat, vectors, strict=True)
        ]
        for one, product in zip(moves, operator.output_curvature(moved), strict=True):
            total += float(product.reshape(len(one), -1)[~one.to(product.device)].double().norm())
    return total


def jacobian(operator: CurvatureOperator) -> Tensor:
    """Return J [M, N] of all M elements of the outputs of the white box by the N parameters: M backward passes."""
    return torch.cat([_rows(operator, index) for index in range(len(operator.through))])


def _rows(operator: CurvatureOperator, index: int) -> Tensor:
    y, rows = operator.through[index], []
    for element in range(y.numel()):
        d = [torch.zeros_like(one, memory_format=torch.contiguous_format) for one in operator.through]
        d[index].view(-1)[element] = 1.0
        rows.append(operator.pull(d))
    return torch.stack(rows)
