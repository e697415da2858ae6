"""The Jacobian of a network whose outputs each depend on one sample of the batch."""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn
from torch.func import functional_call
from torch.overrides import TorchFunctionMode

from torch_zerohess.autograd.graph import uses_of
from torch_zerohess.evaluation_mode import BATCH_NORMS, mixes_in_evaluation
from torch_zerohess.linalg.flat import flattened
from torch_zerohess.linalg.jacobians import Blocks, Jacobian, OuterProducts, Rows

_OF_TRAINING = (
    *BATCH_NORMS,
    *(nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.Dropout3d, nn.AlphaDropout, nn.FeatureAlphaDropout, nn.RReLU),
)
"""Modules that in training mode mix samples or draw random numbers."""

_WITH_DROPOUT = (nn.RNNBase, nn.MultiheadAttention)
"""Modules that draw random numbers in training mode if their `dropout` is positive."""

_DRAWS = (
    "network draws random numbers, and has no Jacobian per sample: call network.eval() first, or take what draws them "
    "out of its forward function"
)


Places = tuple[str, ...]
"""Names of a parameter."""


class SampleJacobian:
    """The Jacobian of a network whose outputs each depend on one sample of the batch: n backward passes for n outputs.

    Made in a closure of `NewtonCG` with solver "dual", which otherwise takes one backward pass for every output of
    every sample. Batch normalisation and dropout must be in evaluation mode: in training mode, batch normalisation
    mixes the samples, and dropout changes the network from call to call. So does the dropout of recurrent layers and
    of attention, and RReLU.

    Args:
        network: a module, inputs [B, ...] -> [B, n], each of its own input.
        inputs: the batch that the closure evaluates, [B, ...].

    Example:
        >>> network, x = torch.nn.Linear(3, 2), torch.ones(4, 3)
        >>> SampleJacobian(network, x)(list(network.parameters())).shape
        torch.Size([8, 8])
    """

    def __init__(self, network: nn.Module, inputs: Tensor) -> None:
        if not isinstance(network, nn.Module):
            raise TypeError(f"network must be a torch.nn.Module, got {type(network).__name__}")
        self._network = network
        self.inputs = inputs

    def __call__(self, parameters: Sequence[Tensor]) -> Tensor:
        """Return J [B n, N] by parameters of the network, N numbers in all.

        Raises ValueError for a parameter that the network does not have, for outputs that are not [B, n], for batch
        normalisation and dropout in training mode, for batch normalisation without running statistics, and for a
        network that draws random numbers. Raises RuntimeError in inference mode.
        """
        return self.products(parameters).dense()

    def products(self, parameters: Sequence[Tensor]) -> Jacobian:
        """Return J as its products. Raises as a call does.

        A weight whose only use is one product with a vector per sample, as in `torch.nn.Linear`, needs no row of J.
        Where torch's `vmap` does not know an operation of the network, as of GRU, there are B n backward passes.
        """
        if torch.is_inference_mode_enabled():
            raise RuntimeError(
                "a Jacobian needs derivatives of the network, which inference mode forbids: use torch.no_grad"
            )
        if (mixing := mixes_in_evaluation(self._network)) is not None:
            raise ValueError(f"network has {mixing}, too: it has no Jacobian per sample")
        for name, one in self._network.named_modules():
            dropout = isinstance(one, _WITH_DROPOUT) and float(one.dropout) > 0.0
            if one.training and (dropout or (isinstance(one, _OF_TRAINING) and getattr(one, "p", 1.0) > 0.0)):
                kind = type(one).__name__ + " with dropout" * dropout
                raise ValueError(
                    f"network has a {kind} in training mode ({name!r}), and no Jacobian per sample: call "
                    "network.eval() first"
                )
        places = self._places()
        if not all(id(one) in places for one in parameters):
            raise ValueError("parameters of the optimizer must be parameters of the network of the SampleJacobian")
        chosen = {places[id(one)]: one.detach() for one in parameters}
        outer = self._outer(chosen)
        slopes = {at: one.new_zeros(len(one)) for at, one in chosen.items() if at in outer}
        rows = {at: one for at, one in chosen.items() if at not in outer}

        def output(
            rows: dict[Places, Tensor], slopes: dict[Places, Tensor], sample: Tensor
        ) -> tuple[Tensor, dict[Places, Tensor]]:
            with _Products({id(chosen[at]): (at, zeros) for at, zeros in slopes.items()}) as products:
                result = _checked(self._called({**chosen, **rows}, sample[None]))
            return result[0], products.inputs

        differentiated = torch.func.vmap(
            torch.func.jacrev(output, argnums=(0, 1), has_aux=True), in_dims=(None, None, 0)
        )
        try:
            (by_rows, by_slopes), inputs = differentiated(rows, slopes, self.inputs)
        except RuntimeError as error:  # torch's vmap does not know the operations of GRU and PReLU, among others
            if "random" in str(error):
                raise ValueError(_DRAWS) from error
            return Rows(self._one_by_one(parameters))

        def part(at: Places) -> Jacobian:
            if at in outer:
                return OuterProducts(by_slopes[at], inputs[at])
            found = by_rows[at].flatten(0, 1)
            return Rows(found.reshape(len(found), chosen[at].numel()))

        return Blocks([part(at) for at in chosen], [one.numel() for one in chosen.values()])

    def mixes_samples(self) -> bool:
        """Whether the last sample has other outputs in a batch of its copies, of the same size and precision."""
        copies = self.inputs[-1:].expand_as(self.inputs).contiguous()
        with torch.no_grad():
            together, alone = _tensor(self._called({}, self.inputs)), _tensor(self._called({}, copies))
        most = math.sqrt(torch.finfo(alone.dtype).eps) * float(together.abs().max())
        return float((together[-1] - alone[-1]).abs().max()) > most

    def _one_by_one(self, parameters: Sequence[Tensor]) -> Tensor:
        """Return the rows by a backward pass for every output of every sample."""
        rows = []
        for sample in self.inputs:
            before = _generators(self.inputs)
            with torch.enable_grad():
                outputs = _checked(self._called({}, sample[None]))[0]
            if not all(map(torch.equal, before, _generators(self.inputs))):
                raise ValueError(_DRAWS)
            for one in outputs:
                gradients = torch.autograd.grad(one, parameters, retain_graph=True, materialize_grads=True)
                rows.append(flattened(gradients))
        return torch.stack(rows)

    def _places(self) -> dict[int, Places]:
        """Return the names of every parameter by its identity: several if modules share it, one if a module repeats."""
        found: dict[int, Places] = {}
        for prefix, module in self._network.named_modules():
            for name, one in module.named_parameters(prefix, recurse=False, remove_duplicate=False):
                found[id(one)] = (*found.get(id(one), ()), name)
        return found

    def _called(self, values: Mapping[Places, Tensor], samples: Tensor) -> object:
        """Return the outputs with other values of parameters. Buffers stay as they are, whatever the network does."""
        given = self._copied_buffers() | {name: one for names, one in values.items() for name in names}
        # torch's own handling of shared parameters (tie_weights) loses a parameter of a module with two names.
        return functional_call(self._network, given, (samples,), tie_weights=False)

    def _copied_buffers(self) -> dict[str, Tensor]:
        """Return a copy of every buffer by its names: several if modules share it, one if a module repeats."""
        copies, given = dict[int, Tensor](), dict[str, Tensor]()
        for prefix, module in self._network.named_modules():
            for name, one in module.named_buffers(prefix, recurse=False, remove_duplicate=False):
                given[name] = copies.setdefault(id(one), one.clone())
        return given

    def _outer(self, chosen: Mapping[Places, Tensor]) -> set[Places]:
        """Return the weights [p, q] whose only use, for one sample, is one product with a vector.

        TorchScript hides its uses of a weight from `_Uses`, but not from the graph.
        """
        leaves = {at: one.clone().requires_grad_() for at, one in chosen.items()}
        with torch.enable_grad(), _Uses(leaves.values()) as uses:
            outputs = self._called(leaves, self.inputs[:1])
        once = {at: one for at, one in leaves.items() if uses.count[id(one)] == 1 and id(one) in uses.products}
        return {at for at, one in once.items() if uses_of(one, _tensor(outputs)) <= 1}


def _generators(inputs: Tensor) -> list[Tensor]:
    """Return the states of torch's own random number generators that a network of these inputs may use."""
    on_device = [torch.cuda.get_rng_state(inputs.device)] if inputs.is_cuda else []
    return [torch.get_rng_state(), *on_device]


def _tensor(outputs: object) -> Tensor:
    if not isinstance(outputs, Tensor):
        raise TypeError(f"network must return a tensor [B, n], got {type(outputs).__name__}")
    return outputs


def _checked(outputs: object) -> Tensor:
    """Return outputs [1, n] of a network; ValueError for another shape, TypeError for what is no tensor."""
    outputs = _tensor(outputs)
    if outputs.ndim != 2 or len(outputs) != 1:
        raise ValueError(f"network must return [1, n] for one sample, got {list(outputs.shape)}: flatten the outputs")
    return outputs


class _Uses(TorchFunctionMode):
    """Counts how often weights are arguments of functions of torch, and notes which are weights of a product."""

    def __init__(self, weights: Iterable[Tensor]) -> None:
        super().__init__()
        self.count = Counter(dict.fromkeys(map(id, weights), 0))
        self.products: set[int] = set()

    def __torch_function__(
        self, function: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        given = kwargs or {}
        self.count.update(id(one) for one in _tensors((args, given)) if id(one) in self.count)
        if function is nn.functional.linear and torch.is_grad_enabled():  # not within a function of its own derivative
            x, weight = _of_product(args, given)
            if x.numel() == x.shape[-1]:
                self.products.add(id(weight))
        return function(*args, **given)


class _Products(TorchFunctionMode):
    """Adds zeros to the products with some weights, whose gradient is the slope there, and keeps what was multiplied.

    zeros: by the identity of the weight, its names and a tensor [p].
    """

    def __init__(self, zeros: Mapping[int, tuple[Places, Tensor]]) -> None:
        super().__init__()
        self._zeros = zeros
        self.inputs: dict[Places, Tensor] = {}

    def __torch_function__(
        self, function: Callable[..., Any], types: Any, args: Sequence[Any] = (), kwargs: Any = None
    ) -> Any:
        given = kwargs or {}
        result = function(*args, **given)
        if function is nn.functional.linear:
            x, weight = _of_product(args, given)
            if id(weight) in self._zeros:
                at, zeros = self._zeros[id(weight)]
                self.inputs[at] = x.reshape(-1)
                result = result + zeros
        return result


def _of_product(args: Sequence[Any], given: Mapping[str, Any]) -> tuple[Tensor, Tensor]:
    """Return input and weight among the arguments of `torch.nn.functional.linear`."""
    both = {**dict(zip(("input", "weight"), args, strict=False)), **given}
    return both["input"], both["weight"]


def _tensors(value: object) -> Iterator[Tensor]:
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from _tensors(one)
    elif isinstance(value, dict):
        yield from _tensors(list(value.values()))
