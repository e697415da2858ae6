"""The curvature of a batch of black boxes as one small matrix per element, and its modification.

Behind a network, H = J^T A J with A = d2l/dy2 over the outputs y [*batch, n] of the network. Where the loss is a sum
over the batch, A is block-diagonal: one matrix [n, n] per element, which n products give for all elements at once.
Sampled matrices are often indefinite. "abs" replaces the eigenvalues of each by their magnitudes, so that J^T A J is
positive (saddle-free Newton: Dauphin et al. 2014).
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.func import functional_call

from torch_zerohess.autograd.curvature import CurvatureOperator

_TOLERANCE = 1e-3
"""Relative error of the blocks against a product with A at which the loss is not a sum over the batch."""

_OF_TRAINING = (
    *(nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm),
    *(nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.Dropout3d, nn.AlphaDropout, nn.FeatureAlphaDropout),
)
"""Modules that in training mode mix samples or draw random numbers."""


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
    vectors = [torch.rand(y.shape, generator=generator, device="cpu").to(y) for y in operator.through]
    products = operator.output_curvature(vectors)
    error = size = 0.0
    for product, block, vector in zip(products, blocks, vectors, strict=True):
        expected = (block @ vector.reshape(len(block), -1, 1).double())[..., 0]
        error += float((product.reshape_as(expected).double() - expected).norm())
        size += float(block.norm())
    if error > _TOLERANCE * size:
        raise ValueError(
            "modification and solver 'dual' need a loss that is a sum or mean over the batch of black boxes, but the "
            "loss couples its elements: use modification=None and solver 'steihaug' or 'clip'"
        )


def magnitudes(blocks: Tensor) -> Tensor:
    """Return the blocks [..., n, n] with the magnitudes of their eigenvalues."""
    values, vectors = torch.linalg.eigh(blocks)
    return (vectors * values.abs()[..., None, :]) @ vectors.mT


def jacobian(operator: CurvatureOperator) -> Tensor:
    """Return J [M, N] of all M elements of the outputs of the white box by the N parameters: M backward passes."""
    return torch.cat([_rows(operator, index) for index in range(len(operator.through))])


def _rows(operator: CurvatureOperator, index: int) -> Tensor:
    y, rows = operator.through[index], []
    for element in range(y.numel()):
        d = [torch.zeros_like(one) for one in operator.through]
        d[index].view(-1)[element] = 1.0
        rows.append(operator.pull(d))
    return torch.stack(rows)


class SampleJacobian:
    """The Jacobian of a network whose outputs each depend on one sample of the batch, in about one backward pass.

    Made in a closure of `NewtonCG` with solver "dual", which otherwise takes one backward pass for every output of the
    batch. Batch normalisation and dropout must be in evaluation mode: in training mode, batch normalisation mixes the
    samples, and dropout changes the network from call to call.

    Args:
        network: a module, samples [B, ...] -> [B, n].
        samples: the batch that the closure evaluates, [B, ...].

    Example:
        >>> network, x = torch.nn.Linear(3, 2), torch.ones(4, 3)
        >>> SampleJacobian(network, x)(list(network.parameters())).shape
        torch.Size([8, 8])
    """

    def __init__(self, network: nn.Module, samples: Tensor) -> None:
        if not isinstance(network, nn.Module):
            raise TypeError(f"network must be a torch.nn.Module, got {type(network).__name__}")
        self._network, self._samples = network, samples

    def __call__(self, parameters: Sequence[Tensor]) -> Tensor:
        """Return J [B n, N] by parameters of the network, N numbers in all.

        Raises ValueError for a parameter that the network does not have, and for batch normalisation and dropout in
        training mode.
        """
        for name, one in self._network.named_modules():
            if one.training and isinstance(one, _OF_TRAINING):
                raise ValueError(
                    f"network has a {type(one).__name__} in training mode ({name!r}), and no Jacobian per sample: call "
                    "network.eval() first"
                )
        names = {id(one): name for name, one in self._network.named_parameters()}
        if not all(id(one) in names for one in parameters):
            raise ValueError("parameters of the optimizer must be parameters of the network of the SampleJacobian")
        chosen = {names[id(one)]: one.detach() for one in parameters}

        def output(values: dict[str, Tensor], sample: Tensor) -> Tensor:
            result: Tensor = functional_call(self._network, values, (sample[None],))
            return result[0]

        jacobians = torch.func.vmap(torch.func.jacrev(output), in_dims=(None, 0))(chosen, self._samples)
        count = next(iter(jacobians.values())).shape[:2].numel()
        return torch.cat([jacobians[name].reshape(count, -1) for name in chosen], 1)
