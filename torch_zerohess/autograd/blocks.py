"""The curvature of a batch of black boxes as one small matrix per element, and its modification.

Behind a network, H = J^T A J with A = d2l/dy2 over the outputs y [*batch, n] of the network. Where the loss is a sum
over the batch, A is block-diagonal: one matrix [n, n] per element, which n products give for all elements at once.
Sampled matrices are often indefinite. "abs" replaces the eigenvalues of each by their magnitudes, so that J^T A J is
positive (saddle-free Newton: Dauphin et al. 2014).
"""

import torch
from torch import Tensor

from torch_zerohess.autograd.curvature import CurvatureOperator

_TOLERANCE = 1e-3
"""Relative error of the blocks against a product with A at which the loss is not a sum over the batch."""


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
    """Compare with a product of A with a vector whose signs alternate from element to element."""
    signs = []
    for index, y in enumerate(operator.through):
        count = y.numel() // y.shape[-1]
        sign = 1.0 - 2.0 * ((torch.arange(count, device=y.device) * (index + 1) + index) % 2)
        signs.append((sign[:, None].to(y) * torch.ones_like(y).reshape(count, -1)).view_as(y))
    products = operator.output_curvature(signs)
    error = size = 0.0
    for product, block, sign in zip(products, blocks, signs, strict=True):
        expected = (block @ sign.reshape(len(block), -1, 1).double())[..., 0]
        error += float((product.reshape_as(expected).double() - expected).norm())
        size += float(block.norm())
    if error > _TOLERANCE * size:
        raise ValueError(
            "modification and solver 'dual' need a loss that is a sum or mean over the batch of black boxes, but the "
            "loss couples its elements: use modification=None and solver 'steihaug' or 'clip'"
        )


def magnitudes(blocks: Tensor) -> Tensor:
    """Return the blocks [B, n, n] with the magnitudes of their eigenvalues."""
    values, vectors = torch.linalg.eigh(blocks)
    return (vectors * values.abs()[:, None]) @ vectors.mT


def jacobian(operator: CurvatureOperator) -> Tensor:
    """Return J [M, N] of all M elements of the outputs of the white box with respect to the N parameters."""
    rows = []
    for index, y in enumerate(operator.through):
        units = torch.eye(y.numel(), dtype=y.dtype, device=y.device).view(y.numel(), *y.shape)
        parts = torch.autograd.grad(
            operator.through[index],
            operator.inputs,
            units,
            retain_graph=True,
            is_grads_batched=True,
            materialize_grads=True,
        )
        rows.append(torch.cat([part.flatten(1) for part in parts], 1))
    return torch.cat(rows)
