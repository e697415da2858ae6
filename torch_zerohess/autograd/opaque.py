"""The black box as one opaque operator: draw, call, reduce to coefficients. It has no derivative of its own.

Transforms of `torch.func` and `torch.compile` must not look into the function, and a batch that `vmap` adds must reach
the function as more points of one call. A custom operator gives both: its vmap rule folds the new dimension into the
batch. Only tensors cross an operator, so the expansion is taken apart and put together again (`Expansion.tensors`,
`Expansion.rebuild`). Plain eager code calls `expand` and skips this.
"""

import itertools
import weakref
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from torch_zerohess.autograd import transforms
from torch_zerohess.estimation.call import BlackBoxCall
from torch_zerohess.estimation.control import Control
from torch_zerohess.estimation.evaluation import evaluate, evaluate_center
from torch_zerohess.estimation.expansion import Expansion
from torch_zerohess.estimation.stein import Layout
from torch_zerohess.estimation.surrogate_mean import nodes as nodes_of
from torch_zerohess.smoothing import Smoothing
from torch_zerohess.surrogates.memory import Memory


class Owner(Protocol):
    """The parts of a module that its operator uses."""

    call: BlackBoxCall
    smoothing: Smoothing
    memory: Memory | None
    control: Control | None
    output_shapes: dict[tuple[int | torch.Size, ...], torch.Size]
    training: bool


def expand(owner: Owner, keep: bool, x: Tensor, aux: Sequence[Tensor]) -> Expansion:
    """Evaluate once around x [B, n], which needs no graph; `keep` stores the perturbations.

    Where autograd records, a head must not have a tensor of its own that requires grad.
    """
    with transforms.random_numbers_allowed():
        expansion = evaluate(owner.call, x, aux, owner.smoothing, keep, owner.control).expansion
    owner.output_shapes[_signature(x.shape[1], aux)] = expansion.base.shape[1:]
    return expansion


def center(owner: Owner, x: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return `expand_center`, after a random number that nobody needs.

    A reentrant checkpoint calls this in its first pass, and draws in its second pass from a copy of the generator.
    Without a draw in the first pass the generator would stay where it is, and all checkpoints would draw the same.
    """
    if owner.training:
        with transforms.outside(), transforms.random_numbers_allowed():
            owner.smoothing.drawn_seed()
    return expand_center(owner, x, aux)


def expand_center(owner: Owner, x: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return f(x), [B, *out], for x [B, n]; ValueError for a sigma that is not [n], as where it is needed."""
    owner.smoothing.sigma_vector(x.shape[1], x.device)
    values = evaluate_center(owner.call, x, aux)
    owner.output_shapes[_signature(x.shape[1], aux)] = values.shape[1:]
    return values.to(x.dtype)


def empty(owner: Owner, x: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return the values [*batch, *out] of a batch x [*batch, n] without points, differentiable in x; aux are [0, ...].

    ValueError if the shape of one value is not known yet. A head returns numbers.
    """
    shape = owner.output_shapes.get(_signature(x.shape[-1], aux))
    if owner.call.head is not None:
        shape = torch.Size()
    elif owner.memory is not None and len(owner.memory):
        shape = owner.memory.outputs.shape[1:]
    if shape is None:
        raise ValueError(
            f"x must have at least one point in the first call, got {list(x.shape)}: fn is not called without points, "
            "so the shape of its output is not known yet"
        )
    nothing = x.sin().sum(-1)  # a graph with derivatives of every order
    return nothing[(..., *[None] * len(shape))].expand(*nothing.shape, *shape)


def nodes(handle: int, seed: int, count: int, x: Tensor, aux: list[Tensor]) -> Tensor:
    """Return `surrogate_mean.nodes` for x [B, n]; each point that vmap maps over gets its own."""
    with transforms.unrecorded():
        if not transforms.transform_active():
            with transforms.random_numbers_allowed():
                return nodes_of(seed, count, x.shape[1], len(x)).to(x.device)
        x = noise_checked(handle, x, aux)
        result: Tensor = torch.ops.torch_zerohess.nodes(handle, seed, count, x, aux)
        return result


_owners: "weakref.WeakValueDictionary[int, Owner]" = weakref.WeakValueDictionary()
_handles = itertools.count()


def register(owner: Owner) -> int:
    """Return a number by which the operators find `owner` for as long as it lives."""
    handle = next(_handles)
    _owners[handle] = owner
    return handle


def _owner(handle: int) -> Owner:
    try:
        return _owners[handle]
    except KeyError:
        raise RuntimeError(
            f"a traced graph calls black box number {handle}, which does not live in this process, or no longer: keep "
            "the layer for as long as the graph, and trace again after loading it elsewhere"
        ) from None


# A compiler may merge two calls with the same inputs, or repeat one of them. Two calls of a black box are two draws,
# and its values may carry noise of their own.
_RANDOM = (torch.Tag.nondeterministic_seeded,)


def noise_checked(handle: int, x: Tensor, aux: list[Tensor]) -> Tensor:
    """Return x; ValueError where a vmap wants different noise for each of its calls, but all of them are one call."""
    if transforms.different_noise_wanted([x, *aux]) and _owner(handle).smoothing.seed is None:
        raise ValueError(
            "vmap(randomness='different') over a black box whose inputs are not mapped over: all share one estimate; "
            "expand x over the mapped dimension, or use randomness='same'"
        )
    return x


@torch.library.custom_op("torch_zerohess::evaluate", mutates_args=(), tags=_RANDOM)
def _evaluate(handle: int, K: int, keep: bool, records: bool, x: Tensor, aux: list[Tensor]) -> list[Tensor]:
    """Return `Expansion.tensors`. K, the number of perturbations, is what the fake kernel needs of the settings.

    records: whether autograd records where the layer is called. Compiled code runs its graph without autograd.
    """
    owner = _owner(handle)
    if (drawn := owner.smoothing.evaluations(x.shape[1], center=False)) != K:
        raise RuntimeError(f"a graph was traced for {K} perturbations, but now the layer draws {drawn}: trace again")
    with transforms.recording(records):
        return expand(owner, keep, x, aux).tensors()


@torch.library.custom_op("torch_zerohess::evaluate_center", mutates_args=(), tags=_RANDOM)
def _evaluate_center(handle: int, records: bool, x: Tensor, aux: list[Tensor]) -> Tensor:
    with transforms.recording(records):
        return expand_center(_owner(handle), x, aux)


@torch.library.custom_op("torch_zerohess::nodes", mutates_args=())
def _nodes(handle: int, seed: int, count: int, x: Tensor, aux: list[Tensor]) -> Tensor:
    with transforms.random_numbers_allowed():
        return nodes_of(seed, count, x.shape[1], len(x)).to(x.device)


def _layout(handle: int, K: int, keep: bool, x: Tensor, aux: list[Tensor]) -> list[Layout]:
    owner = _owner(handle)
    smoothing = owner.smoothing if keep else owner.smoothing.resolved(int(x.shape[1]))
    out, constants = _output_shape(owner, x, aux), owner.call.outer.constants
    return Expansion.layout(smoothing, x.shape[0], K, x.shape[1], out, constants, keep)


@_evaluate.register_fake
def _(handle: int, K: int, keep: bool, records: bool, x: Tensor, aux: list[Tensor]) -> list[Tensor]:
    return [x.new_empty(one.shape, dtype=one.dtype) for one in _layout(handle, K, keep, x, aux)]


@_evaluate_center.register_fake
def _(handle: int, records: bool, x: Tensor, aux: list[Tensor]) -> Tensor:
    return x.new_empty(len(x), *_output_shape(_owner(handle), x, aux))


@_nodes.register_fake
def _(handle: int, seed: int, count: int, x: Tensor, aux: list[Tensor]) -> Tensor:
    return x.new_empty(len(x), 2 * ((count + 1) // 2), x.shape[1], dtype=torch.float64)


def _signature(n: int, aux: Sequence[Tensor]) -> tuple[int | torch.Size, ...]:
    """What the shape of one value may depend on."""
    return (int(n), *(torch.Size(map(int, one.shape[1:])) for one in aux))


def _output_shape(owner: Owner, x: Tensor, aux: Sequence[Tensor]) -> torch.Size:
    """Shape of one value: known from an earlier call, or from calling the black box once at zero."""
    signature = _signature(x.shape[1], aux)
    if signature not in owner.output_shapes:
        with transforms.real_tensors(), transforms.recording(False):
            probe = torch.zeros(1, int(x.shape[1]), dtype=x.dtype, device=x.device)
            others = [torch.zeros(1, *map(int, one.shape[1:]), dtype=one.dtype, device=one.device) for one in aux]
            try:
                owner.output_shapes[signature] = owner.call.values(probe[:, None], others)[0].shape[2:]
            except Exception as error:
                raise RuntimeError(
                    "torch.compile needs the output shape of the black box, and calling it at zero failed: call the "
                    "layer once on real data before compiling it"
                ) from error
    return owner.output_shapes[signature]


def _mapped(info: Any, in_dims: Any, x: Tensor, aux: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
    """Fold the dimension that vmap maps over into the batch."""
    if not info.batch_size:
        raise ValueError("x must have at least one point under vmap, got a mapped dimension of length 0")

    def fold(one: Tensor, dim: int | None) -> Tensor:
        one = one.expand(info.batch_size, *one.shape) if dim is None else one.movedim(dim, 0)
        return one.flatten(0, 1)

    return fold(x, in_dims[-2]), [fold(one, dim) for one, dim in zip(aux, in_dims[-1], strict=True)]


def _check_randomness(info: Any, handle: int) -> None:
    if info.randomness == "same" and _owner(handle).smoothing.seed is None:
        raise ValueError(
            "vmap(randomness='same') over a black box: its noise is independent for each point of a batch; use "
            "randomness='different', or give Smoothing a seed"
        )


@_evaluate.register_vmap
def _(info: Any, in_dims: Any, handle: int, K: int, keep: bool, records: bool, x: Tensor, aux: list[Tensor]) -> Any:
    _check_randomness(info, handle)
    folded, others = _mapped(info, in_dims, x, aux)
    results = _evaluate(handle, K, keep, records, folded, others)
    batched = [one.batched for one in _layout(handle, K, keep, folded, others)]  # after it: the shape is known by now
    unfolded = [
        one.unflatten(0, (info.batch_size, -1)) if each else one for one, each in zip(results, batched, strict=True)
    ]
    return unfolded, [0 if each else None for each in batched]


@_nodes.register_vmap
def _(info: Any, in_dims: Any, handle: int, seed: int, count: int, x: Tensor, aux: list[Tensor]) -> Any:
    _check_randomness(info, handle)
    folded, others = _mapped(info, in_dims, x, aux)
    return _nodes(handle, seed, count, folded, others).unflatten(0, (info.batch_size, -1)), 0


@_evaluate_center.register_vmap
def _(info: Any, in_dims: Any, handle: int, records: bool, x: Tensor, aux: list[Tensor]) -> Any:
    folded, others = _mapped(info, in_dims, x, aux)
    return _evaluate_center(handle, records, folded, others).unflatten(0, (info.batch_size, -1)), 0
