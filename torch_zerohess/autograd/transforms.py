"""Questions about torch's transforms that have no public answer: the file with the private names of torch.

All of these names were tried with torch 2.15. If a version of torch drops one, it is replaced here. One more,
`Tensor._version`, is in `estimation/inputs.py`, which must not import from here: how often a tensor was changed.

| question | private name | why no public name serves |
|---|---|---|
| is a functorch transform active | `torch._C._functorch.maybe_current_level` | `torch.func` does not tell |
| which tensor a functorch wrapper holds | `torch._C._functorch.get_unwrapped`, `is_functorch_wrapped_tensor` | \
`torch.func.debug_unwrap` skips all levels at once |
| is a forward-mode level open | `forward_ad._current_level` | `forward_ad.unpack_dual` answers for one tensor only |
| how large is a batch under vmap | `torch._C._functorch.is_batchedtensor`, `maybe_get_level`, `maybe_get_bdim` | \
`torch.func` does not tell |
| does `is_grads_batched` map over it | `torch._C._functorch.is_legacy_batchedtensor` | it is a vmap of its own |
| which `randomness` has a vmap | `torch._C._functorch.get_interpreter_stack`, `CVmapInterpreterPtr`, `TransformType`, \
`RandomnessType` | a vmap rule is told, but is not called where it maps over nothing |
| how often is forward mode nested | `torch._C._functorch.get_interpreter_stack`, `TransformType` | `torch.func` does \
not tell |
| is every operation watched | `torch._C._len_torch_dispatch_stack` | `torch.utils._python_dispatch` is private too |
| does `make_fx` record operations, and on which inputs a tensor depends | `torch._C._get_dispatch_mode`, \
`torch.fx.experimental.proxy_tensor` | `torch.func.linearize` records operations on constants, too |
| may random numbers be drawn | `torch._C._ExcludeDispatchKeyGuard`, `DispatchKeySet`, `_parse_dispatch_key` | \
`torch.autograd.functional` does not pass on the `randomness` of `torch.vmap` |
| let torch see what a custom operator does | `torch._C._ForceDispatchKeyGuard`, `_dispatch_tls_local_include_set`, \
`_dispatch_tls_local_exclude_set` | autograd never sees it, `torch.func` and others do not see it where torch compiles |
| leave all transforms for a while | `torch._functorch.pyfunctorch.temporarily_clear_interpreter_stack` | \
a random seed is drawn once, whatever maps over the layer |
| real tensors in a fake kernel | `torch._subclasses.fake_tensor.unset_fake_temporarily` | none exists |
| is a tensor a symbolic zero | `Tensor._is_zerotensor` | none exists |
| which function made this node | `Function._backward_cls` | `Node.name()` is a string that other functions may share |
| did `torch.compile` make this node | `CompiledFunctionBackward`, its name | every graph has a class of its own |
"""

import contextlib
import math
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from typing import cast

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.autograd.graph import Node


def transform_active() -> bool:
    """Whether a transform of `torch.func` is active: grad, vjp, jvp, vmap, or one composed of these."""
    return torch._C._functorch.maybe_current_level() is not None


def jit_traces() -> bool:
    """Whether `torch.jit.trace` records operations."""
    return bool(torch.jit.is_tracing())  # type: ignore[attr-defined, no-untyped-call]


def forward_mode_active() -> bool:
    """Whether a level of forward-mode differentiation is open in any thread, so that a tensor may carry a tangent."""
    return forward_ad._current_level >= 0


def forward_modes() -> int:
    """Return how many levels of forward mode of `torch.func` are open."""
    functorch = torch._C._functorch
    return sum(one.key() == functorch.TransformType.Jvp for one in functorch.get_interpreter_stack() or ())


def has_tangent(x: Tensor) -> bool:
    """Whether x carries a tangent of forward-mode differentiation. A level that another thread opened gives it none."""
    return forward_mode_active() and forward_ad.unpack_dual(x).tangent is not None


def watched(x: Tensor) -> bool:
    """Whether operations on x are transformed, traced or dispatched to Python, so that values are not to be looked at.

    It asks for `torch.compile`, for transforms of `torch.func`, for dispatch modes (fake tensors, tracers) and for
    subclasses of Tensor.
    """
    return (
        torch.compiler.is_compiling()
        or transform_active()
        or torch._C._len_torch_dispatch_stack() > 0
        or type(x) not in (Tensor, torch.nn.Parameter)
    )


def recorded(tensors: Sequence[Tensor]) -> bool:
    """Whether a compiler or `make_fx` records operations, and a tensor depends on an input of what it records.

    `torch.func.linearize` records operations at a fixed x. There only the tangents are inputs.
    """
    if torch.compiler.is_compiling():
        return True
    mode = torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.PROXY)
    if mode is None:
        return False
    from torch.fx.experimental.proxy_tensor import get_proxy_slot  # make_fx has loaded it

    seen: set[object] = set()
    left = []
    for one in tensors:
        while torch._C._functorch.is_functorch_wrapped_tensor(one):
            one = torch._C._functorch.get_unwrapped(one)
        slot = get_proxy_slot(one, mode.tracer, None)
        if slot is not None:
            left.append(slot.proxy.node)
    while left:
        node = left.pop()
        if node.op == "placeholder":
            return True
        new = [one for one in node.all_input_nodes if one not in seen]
        seen.update(new)
        left += new
    return False


def unrecorded() -> AbstractContextManager[object]:
    """Compute numbers that are constants of what `make_fx` records."""
    if torch.compiler.is_compiling() or torch._C._get_dispatch_mode(torch._C._TorchDispatchModeKey.PROXY) is None:
        return contextlib.nullcontext()
    from torch.fx.experimental.proxy_tensor import disable_proxy_modes_tracing  # make_fx has loaded it

    return disable_proxy_modes_tracing()


def derivative_wanted(x: Tensor) -> bool:
    """Whether a derivative with respect to x is recorded, at any level of nested transforms."""
    if torch.compiler.is_compiling():
        return torch.is_grad_enabled() and x.requires_grad
    while True:
        if x.requires_grad and torch.is_grad_enabled():
            return True
        if has_tangent(x):
            return True
        if not torch._C._functorch.is_functorch_wrapped_tensor(x):
            return False
        x = torch._C._functorch.get_unwrapped(x)


def derivative_possible(x: Tensor) -> bool:
    """Whether anybody may ask for a derivative with respect to x; where in doubt, yes."""
    if torch.compiler.is_compiling():
        return forward_mode_active() or derivative_wanted(x)
    return transform_active() or derivative_wanted(x)


def _mapped(x: Tensor) -> Iterator[tuple[int, int]]:
    """Yield each level of vmap over x, and its size."""
    functorch = torch._C._functorch
    while functorch.is_functorch_wrapped_tensor(x):
        inner = functorch.get_unwrapped(x)
        if functorch.is_batchedtensor(x):
            yield functorch.maybe_get_level(x), int(inner.shape[functorch.maybe_get_bdim(x)])
        x = inner


def mapped_in_graph(gradient: Tensor) -> bool:
    """Whether a gradient of `is_grads_batched` is to have a graph, which functions applied to it lose without an error.

    That vmap is older than `torch.func`. It maps over operations, and does not ask a function for its rule.
    """
    return torch.is_grad_enabled() and torch._C._functorch.is_legacy_batchedtensor(gradient)


def mapped_size(tensors: Sequence[Tensor]) -> int:
    """Return how many times larger a batch is than it seems: the product of the sizes of all vmaps over it."""
    return math.prod(dict(pair for one in tensors for pair in _mapped(one)).values())


def shown(x: Tensor) -> Tensor | None:
    """Return the values of x without a graph, of the first element wherever vmap maps over it; None if nobody may look.

    To be called under `outside`.
    """
    functorch = torch._C._functorch
    if torch.compiler.is_compiling() or torch._C._len_torch_dispatch_stack() > 0:
        return None
    mapped = []
    while functorch.is_functorch_wrapped_tensor(x):
        if functorch.is_batchedtensor(x):
            mapped.append(functorch.maybe_get_bdim(x))
        x = functorch.get_unwrapped(x)
    for dim in reversed(mapped):  # each counts the dimensions that the vmap around it leaves
        x = x.select(dim, 0)
    return x.detach() if type(x) in (Tensor, torch.nn.Parameter) else None


def different_noise_wanted(tensors: Sequence[Tensor]) -> bool:
    """Whether a vmap with randomness="different" is active that maps over none of the tensors."""
    functorch = torch._C._functorch
    levels = {level for one in tensors for level, _ in _mapped(one)}
    return any(
        one.key() == functorch.TransformType.Vmap
        and functorch.CVmapInterpreterPtr(one).randomness() == functorch.RandomnessType.Different
        and one.level() not in levels
        for one in functorch.get_interpreter_stack() or ()
    )


def random_numbers_allowed() -> AbstractContextManager[None]:
    """Allow random numbers under the vmap that `torch.autograd.functional` uses for a forward-mode Jacobian.

    That vmap maps over tangents only, but it forbids random numbers in everything below.
    """
    return cast("AbstractContextManager[None]", torch._C._ExcludeDispatchKeyGuard(_VMAP_MODE))


def outside() -> AbstractContextManager[None]:
    """Compute with plain tensors, random ones included, as if no transform of `torch.func` were active."""
    from torch._functorch.pyfunctorch import temporarily_clear_interpreter_stack  # loaded late: slow to import

    return cast("AbstractContextManager[None]", temporarily_clear_interpreter_stack())


_VMAP_MODE = torch._C.DispatchKeySet(torch._C._parse_dispatch_key("VmapMode"))  # type: ignore[arg-type]


_HIDDEN = torch._C.DispatchKeySet(torch._C._parse_dispatch_key("AutogradFunctionality"))  # type: ignore[arg-type]
for _key in (
    *("AutogradOther", "AutogradNestedTensor", "ADInplaceOrView"),
    # A call that compiles hides these, too. A conjugate that is not computed yet then counts as the number itself.
    *("Conjugate", "Negative", "ZeroTensor", "Functionalize", "Batched", "Tracer", "PythonTLSSnapshot"),
    *("FuncTorchDynamicLayerFrontMode", "FuncTorchDynamicLayerBackMode", "FuncTorchGradWrapper"),
    *("FuncTorchBatched", "FuncTorchVmapMode"),
):
    _HIDDEN = _HIDDEN.add(torch._C._parse_dispatch_key(_key))  # type: ignore[arg-type]


@contextlib.contextmanager
def recording(records: bool) -> Iterator[None]:
    """Compute inside a custom operator as outside of it, and let autograd record, or not."""
    include, exclude = torch._C._dispatch_tls_local_include_set(), torch._C._dispatch_tls_local_exclude_set()
    with torch.set_grad_enabled(records), torch._C._ForceDispatchKeyGuard(include, exclude - _HIDDEN):
        yield


def real_tensors() -> AbstractContextManager[None]:
    """Compute with real tensors inside a fake kernel."""
    from torch._subclasses.fake_tensor import unset_fake_temporarily  # loaded late: slow to import

    return cast("AbstractContextManager[None]", unset_fake_temporarily())


def is_symbolic_zero(x: Tensor) -> bool:
    """Whether x is a zero of forward mode that has a shape, but no memory to read."""
    return x._is_zerotensor()


def made_by(node: Node | None, function: type[torch.autograd.Function]) -> bool:
    """Whether a node of the graph is the backward of `function`."""
    return isinstance(node, function._backward_cls)


def compiled(node: Node) -> bool:
    """Whether a node of the graph is a backward of `torch.compile`, which has no derivative."""
    return node.name() == "CompiledFunctionBackward"
