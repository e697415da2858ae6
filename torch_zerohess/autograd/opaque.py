"""The black box as one opaque operator: draw, call, reduce to coefficients. It has no derivative of its own.

Under `torch.func` transforms and `torch.compile` the function must not be looked into, and a batch that `vmap` adds
must reach it as more points of one call. A custom operator gives both: its vmap rule folds the new dimension into the
batch. Plain eager code calls `evaluate_tensors` directly.
"""

import functools
import itertools
import weakref
from collections.abc import Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from torch_zerohess.estimation.evaluation import BlackBoxCall, evaluate, evaluate_center
from torch_zerohess.estimation.perturbations import Perturbations
from torch_zerohess.estimation.stein import Elementwise, LikelihoodRatio, SignedLobes, Stein
from torch_zerohess.sampling.kernels import Redrawn
from torch_zerohess.smoothing import Smoothing


class Owner(Protocol):
    """What an operator needs to know of the module it serves."""

    call: BlackBoxCall
    smoothing: Smoothing
    output_shapes: dict[tuple[int | torch.Size, ...], torch.Size]


class Reduction(NamedTuple):
    """Evaluations as tensors alone: value, coefficients and Stein sums of a batch."""

    base: Tensor
    """float64 [B, *out]"""
    coefficients: Tensor
    """float64 [B, K, *out]"""
    u: Tensor
    """float64 [B, K, n], or [B, 0, n] where the perturbations are not stored"""
    weight: Tensor
    """float64 [B, K]"""
    rows: Tensor
    """int64 [B, S, 5]"""
    sigma: Tensor
    """float64 [n]"""

    def stein(self, smoothing: Smoothing, x: Tensor) -> Stein:
        """Put the Stein sums together again for x [B, n]."""
        n = x.shape[1]
        if smoothing.proposal == "fr22":
            return SignedLobes(self.u)
        if smoothing.proposal == "optimal":
            rows = self.rows[0].repeat(1 + smoothing.antithetic, 1)
            return Elementwise(self.weight, rows, n, smoothing.order)
        if self.u.shape[1]:
            return LikelihoodRatio(self.u, self.weight)
        recipe = self.rows.flatten(0, 1), x.detach().double(), self.sigma
        return LikelihoodRatio(Redrawn(*recipe, smoothing.antithetic, x.dtype == torch.float32), self.weight)


def evaluate_tensors(owner: Owner, keep: bool, x: Tensor, aux: Sequence[Tensor]) -> Reduction:
    """Evaluate once around x [B, n] and return the result as tensors; `keep` stores the perturbations."""
    # Forward mode of torch.autograd.functional maps over tangents only, but forbids random numbers in everything below.
    with torch._C._ExcludeDispatchKeyGuard(_VMAP_MODE):
        result = evaluate(owner.call, x, aux, owner.smoothing, keep)
    owner.output_shapes[_signature(x, aux)] = result.base.shape[1:]
    perturbations: Perturbations = result.perturbations
    B, K, n = perturbations.points.shape
    stein = perturbations.stein
    u = stein.u if isinstance(stein, (LikelihoodRatio, SignedLobes)) else None
    weight = stein.weight if isinstance(stein, (LikelihoodRatio, Elementwise)) else None
    return Reduction(
        result.base.clone(),
        result.coefficients,
        u if isinstance(u, Tensor) else result.base.new_empty(B, 0, n),
        result.base.new_empty(B, K) if weight is None else weight,
        perturbations.rows.view(B, -1, 5),
        perturbations.sigma.clone(),  # not the settings' own tensor: compiled code reuses the buffers it is given
    )


_VMAP_MODE = torch._C.DispatchKeySet(torch._C._parse_dispatch_key("VmapMode"))  # type: ignore[arg-type]
_owners: "weakref.WeakValueDictionary[int, Owner]" = weakref.WeakValueDictionary()
_handles = itertools.count()


def register(owner: Owner) -> int:
    """Return a number by which the operators find `owner` for as long as it lives."""
    handle = next(_handles)
    _owners[handle] = owner
    return handle


@torch.library.custom_op("torch_zerohess::evaluate", mutates_args=())
def _evaluate(
    handle: int, K: int, keep: bool, x: Tensor, aux: list[Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
    with torch.no_grad():
        return evaluate_tensors(_owners[handle], keep, x, aux)


@torch.library.custom_op("torch_zerohess::evaluate_center", mutates_args=())
def _evaluate_center(handle: int, x: Tensor, aux: list[Tensor]) -> Tensor:
    values = evaluate_center(_owners[handle].call, x, aux)
    _owners[handle].output_shapes[_signature(x, aux)] = values.shape[1:]
    return values.to(x.dtype)


@_evaluate.register_fake
def _(handle: int, K: int, keep: bool, x: Tensor, aux: list[Tensor]) -> tuple[Tensor, ...]:
    owner = _owners[handle]
    out = _output_shape(owner, x, aux)
    B, n = x.shape
    S = K // (1 + owner.smoothing.antithetic)
    empty = functools.partial(x.new_empty, dtype=torch.float64)
    coefficients, u, rows = (
        empty((B, K, *out)),
        empty((B, K if keep else 0, n)),
        x.new_empty((B, S, 5), dtype=torch.int64),
    )
    return empty((B, *out)), coefficients, u, empty((B, K)), rows, empty((n,))


@_evaluate_center.register_fake
def _(handle: int, x: Tensor, aux: list[Tensor]) -> Tensor:
    return x.new_empty(len(x), *_output_shape(_owners[handle], x, aux))


def _signature(x: Tensor, aux: Sequence[Tensor]) -> tuple[int | torch.Size, ...]:
    """What the shape of one value may depend on."""
    return (int(x.shape[1]), *(torch.Size(map(int, one.shape[1:])) for one in aux))


def _output_shape(owner: Owner, x: Tensor, aux: Sequence[Tensor]) -> torch.Size:
    """Shape of one value: known from an earlier call, or from calling the black box once at zero."""
    signature = _signature(x, aux)
    if signature not in owner.output_shapes:
        from torch._subclasses.fake_tensor import unset_fake_temporarily

        with unset_fake_temporarily(), torch.no_grad():
            probe = torch.zeros(1, int(x.shape[1]), dtype=x.dtype, device=x.device)
            others = [torch.zeros(1, *map(int, one.shape[1:]), dtype=one.dtype, device=one.device) for one in aux]
            try:
                owner.output_shapes[signature] = owner.call(probe, others).shape[1:]
            except Exception as error:
                raise RuntimeError(
                    "torch.compile needs the output shape of the black box, and calling it at zero failed: call the "
                    "layer once on real data before compiling it"
                ) from error
    return owner.output_shapes[signature]


def _mapped(info: Any, in_dims: Any, x: Tensor, aux: list[Tensor]) -> tuple[Tensor, list[Tensor]]:
    """Fold the dimension that vmap maps over into the batch."""

    def fold(one: Tensor, dim: int | None) -> Tensor:
        one = one.expand(info.batch_size, *one.shape) if dim is None else one.movedim(dim, 0)
        return one.flatten(0, 1)

    return fold(x, in_dims[-2]), [fold(one, dim) for one, dim in zip(aux, in_dims[-1], strict=True)]


@_evaluate.register_vmap
def _(info: Any, in_dims: Any, handle: int, K: int, keep: bool, x: Tensor, aux: list[Tensor]) -> Any:
    folded, others = _mapped(info, in_dims, x, aux)
    *results, sigma = _evaluate(handle, K, keep, folded, others)
    return (*(one.unflatten(0, (info.batch_size, -1)) for one in results), sigma), (0, 0, 0, 0, 0, None)


@_evaluate_center.register_vmap
def _(info: Any, in_dims: Any, handle: int, x: Tensor, aux: list[Tensor]) -> Any:
    folded, others = _mapped(info, in_dims, x, aux)
    return _evaluate_center(handle, folded, others).unflatten(0, (info.batch_size, -1)), 0


def transformed(x: Tensor) -> bool:
    """Whether somebody looks at the computation: a functorch transform, a tracer, a dispatch mode."""
    return (
        torch.compiler.is_compiling()
        or torch._C._functorch.maybe_current_level() is not None
        or torch._C._len_torch_dispatch_stack() > 0
        or type(x) not in (Tensor, torch.nn.Parameter)
    )
