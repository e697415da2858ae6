"""The white box after a black box: a head turns outputs into losses, for every point of a batch.

A head `head(outputs [K, *out], *aux [K, ...]) -> [K]` sees the auxiliary inputs, the black box does not. Auxiliary
inputs are never copied: the head is called once per sample with the whole batch, or once per batch element with
expanded views, whichever takes fewer calls.
"""

import inspect
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from torch_zerohess.estimation.inputs import times_changed
from torch_zerohess.precision import without_autocast

Head = Callable[..., Tensor]
"""(outputs [K, *out], *aux [K, ...]) -> [K], made of differentiable torch operations."""
_ALONE = (
    "but only derivatives with respect to x are made: call requires_grad_(False) or detach() first, put trainable "
    "parts behind a layer without a head, or work under torch.no_grad()"
)


def apply_head(head: Head, outputs: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return the losses [B, E] of outputs [B, E, *out] with auxiliary inputs [B, ...].

    Raises ValueError for a head that changes an auxiliary input in place and, where autograd records, for one with a
    tensor of its own that requires grad.
    """
    B, E = outputs.shape[:2]
    if E <= B:
        return torch.stack([_called(head, outputs[:, sample], aux) for sample in range(E)], 1)
    rows = []
    for element in range(B):
        views = [one[element].expand(E, *one.shape[1:]) for one in aux]
        rows.append(_called(head, outputs[element], views))
    return torch.stack(rows)


def _called(head: Head, outputs: Tensor, aux: Sequence[Tensor]) -> Tensor:
    graph, before = any(one.requires_grad for one in (outputs, *aux)), [times_changed(one) for one in aux]
    with without_autocast(outputs.device):
        try:
            losses = head(outputs, *aux)
        except TypeError as error:
            if (takes := _other_arguments(head, len(aux))) is None:
                raise
            raise TypeError(
                f"head takes {takes}, but the call has {len(aux)} auxiliary inputs: they follow x, layer(x, references)"
            ) from error
    for number, one in enumerate(aux):
        if times_changed(one) != before[number]:
            raise ValueError(
                f"head must not change aux[{number}], which serves other samples and is the caller's: use a copy of it"
            )
    if not isinstance(losses, Tensor) or not losses.is_floating_point():
        got = losses.dtype if isinstance(losses, Tensor) else type(losses)
        raise TypeError(f"head must return a real floating-point tensor, got {got}")
    if losses.requires_grad and not graph:
        raise ValueError(f"head depends on a tensor that requires grad, {_ALONE}")
    if losses.shape != outputs.shape[:1]:
        raise ValueError(
            f"head must return one loss per output, [{len(outputs)}] for outputs {list(outputs.shape)}, "
            f"got {list(losses.shape)}"
        )
    return losses


def _other_arguments(head: Head, count: int) -> str | None:
    """Return the signature of a head that cannot be called with `count` auxiliary inputs, None where it can be."""
    try:
        signature = inspect.signature(head.forward if isinstance(head, torch.nn.Module) else head)
        signature.bind(*[None] * (1 + count))
    except TypeError:
        return str(signature.replace(return_annotation=inspect.Signature.empty))
    except ValueError:  # a head without a signature
        return None
    return None
