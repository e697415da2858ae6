"""Derivatives behind a network that makes thousands of parameters: by `BlackBox`, with a memory, and `SparseBlackBox`.

A linear network makes four textures, POSTER renders them, and the loss is the mean squared distance of the images from
others. The error is relative, of the gradient in the weights and of the product of the Gauss-Newton matrix with a
random vector. The truth is from finite differences of the renderer, which is nearly linear in the texels. The network
stays the same from call to call, and the samples differ: what earlier calls have told is all that changes.
"""

import time
from collections.abc import Callable
from dataclasses import astuple, dataclass

import torch
from torch import Tensor, nn

import torch_zerohess as zh
from experiments.problems import catalogue
from experiments.problems.task import Task
from experiments.reports import result_files

_BATCH, _INPUTS = 4, 16
_SPREAD, _SIGMA = 0.2, 0.1
"""Of the texels: what the weights of a new linear layer are multiplied by, and the smoothing."""
_STEP = 1e-3
"""Of the finite differences."""
HEADERS = ("layer", "renders per call", "call", "error of the gradient", "error of the product", "seconds")


@dataclass(frozen=True)
class LayerError:
    """How well one call of a layer estimates the derivatives."""

    layer: str
    evaluations: int
    """Of this call."""
    call: int
    gradient: float
    product: float
    seconds: float
    """Of the processor, renders included."""


def sparse_layers(
    samples: tuple[int, ...] = (24, 48, 96), calls: int = 4, seed: int = 0, store: str | None = None
) -> list[LayerError]:
    """Print how well layers estimate the derivatives of a loss behind a network, POSTER and 1 024 texels.

    Args:
        samples: antithetic pairs per texture.
        calls: of each layer.
        seed: of the network and of the samples.
        store: name under which the table is kept.
    """
    result_files.may_keep(store)
    torch.set_num_threads(1)
    task = catalogue.fitting("poster")
    rows = compared(task, samples, calls, seed)
    result_files.show(HEADERS, [list(astuple(row)) for row in rows], store)
    return rows


def compared(task: Task, samples: tuple[int, ...], calls: int, seed: int) -> list[LayerError]:
    """Return the accuracy of every layer on a task whose image is nearly linear in its parameters."""
    assert task.output is not None
    image = task.output.image
    torch.manual_seed(seed)
    network = nn.Linear(_INPUTS, task.n).double()
    with torch.no_grad():
        network.weight.mul_(_SPREAD)  # texels well within their range: beyond it nothing changes
        network.bias.fill_(0.5)
    inputs, v = torch.randn(_BATCH, _INPUTS).double(), torch.randn_like(network.weight)
    wanted = image(torch.rand(_BATCH, task.n).double())
    textures = network(inputs).detach()
    truth = _truth(_jacobian(image, textures[0]), image(textures) - wanted, inputs, v)

    def dense(smoothing: zh.Smoothing) -> Callable[[Tensor], Tensor]:
        layer = zh.BlackBox(image, smoothing)
        return lambda x: (layer(x) - wanted).square().mean((1, 2)).mean()

    def remembering(smoothing: zh.Smoothing) -> Callable[[Tensor], Tensor]:
        memory = zh.Memory(zh.surrogates.SparseSurrogate())
        layer = zh.BlackBox(image, smoothing, head=zh.heads.SquaredError(), memory=memory)
        return lambda x: layer(x, wanted).mean()

    def sparse(smoothing: zh.Smoothing) -> Callable[[Tensor], Tensor]:
        layer = zh.SparseBlackBox(image, smoothing)
        return lambda x: (layer(x) - wanted).square().mean((1, 2)).mean()

    rows = []
    for count in samples:
        for name, make in (("BlackBox", dense), ("BlackBox, Memory", remembering), ("SparseBlackBox", sparse)):
            torch.manual_seed(seed)
            loss_of = make(zh.Smoothing(sigma=_SIGMA, samples=count))
            for call in range(1, calls + 1):
                began = time.process_time()
                loss = loss_of(network(inputs))
                (gradient,) = torch.autograd.grad(loss, network.weight, retain_graph=True)
                (product,) = zh.hvp(loss, [network.weight], [v], mode="gauss_newton")
                seconds = time.process_time() - began
                errors = [float((a - b).norm() / b.norm()) for a, b in zip((gradient, product), truth, strict=True)]
                rows.append(LayerError(name, _BATCH * (2 * count + 1), call, errors[0], errors[1], seconds))
    return rows


def _jacobian(image: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Return the Jacobian [m, n] at x [n] by central differences."""
    steps = _STEP * torch.eye(len(x), dtype=x.dtype)
    return torch.stack([(image((x + s)[None]) - image((x - s)[None])).flatten() for s in steps], 1) / (2 * _STEP)


def _truth(jacobian: Tensor, residuals: Tensor, inputs: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
    """Return the gradient of the loss in the weights, and the product with v, both [n, inputs]."""
    scale = 2.0 / residuals.numel()
    gradient = scale * (jacobian.mT @ residuals.flatten(1).mT) @ inputs
    product = scale * (jacobian.mT @ (jacobian @ (v @ inputs.mT))) @ inputs
    return gradient, product
