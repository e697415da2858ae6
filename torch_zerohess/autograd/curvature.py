"""Grey-box curvature: the Hessian of a loss behind a network and a black box, as a matrix-free operator.

For a loss L(theta) = l(y(theta)) with white-box y (a network) and sampled l (a black box and whatever follows it),

    exact          H = J^T (d2l/dy2) J + sum_k (dl/dy_k) d2y_k/dtheta2
    gauss_newton   H = J^T (d2l/dy2) J,      J = dy/dtheta

The supplement of Wang, Fischer and Ritschel (2025, section E) calls the second one the grey-box Hessian. It drops the
term in the curvature of the network, hence "approximately" in the source.
"""

import sys
from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import Any, overload

import torch
from torch import Tensor

from torch_zerohess.arguments import check_tensors
from torch_zerohess.autograd.graph import COMPILED, black_box_inputs, check_once, check_through, check_twice
from torch_zerohess.autograd.tracing import never_compiled
from torch_zerohess.linalg.flat import flattened, split_like, widest_type

_DENSE = 10_000
"""Parameters beyond which `to_dense` refuses: the matrix would take 800 MB in float64."""


class CurvatureOperator:
    """Hessian of a scalar loss with respect to parameters, as a symmetric matrix-free operator.

    Args:
        outputs: the loss, a tensor of one element with a graph. The graph is kept.
        inputs: the parameters, one tensor or several, N numbers in all. Products are in the widest of their types.
        mode: "exact" or "gauss_newton", see the module. With "gauss_newton" only the curvature through the inputs of
            the black boxes counts: a term of the loss that reaches the parameters in another way adds none.
        through: for "gauss_newton", the tensors y at which the white box ends, each on the path to the loss, and none
            computed from another; the inputs of all `BlackBox` layers between `inputs` and `outputs` if None.

    Raises:
        TypeError: `outputs`, or one of `inputs` or `through`, is no tensor.
        RuntimeError: `torch.compile` made the backward that is to be differentiated.
        ValueError: `outputs` has no graph or more than one element; nothing to go through was found, or one black box
            stands behind another; the loss is not computed from every tensor of `through`, or one of these from another
            one; a tensor is given twice.

    Example:
        >>> w = torch.tensor([1.0, 2.0], requires_grad=True)
        >>> H = CurvatureOperator((w**3).sum(), w)
        >>> H.shape, H @ torch.tensor([1.0, 0.0])
        ((2, 2), tensor([6., 0.]))
    """

    @never_compiled
    def __init__(
        self,
        outputs: Tensor,
        inputs: Tensor | Sequence[Tensor],
        *,
        mode: str = "exact",
        through: Tensor | Sequence[Tensor] | None = None,
    ) -> None:
        if mode not in ("exact", "gauss_newton"):
            raise ValueError(f"mode must be 'exact' or 'gauss_newton', got {mode!r}")
        if mode == "exact" and through is not None:
            raise ValueError("through goes with mode 'gauss_newton'; 'exact' differentiates everything")
        if not isinstance(outputs, Tensor):
            raise TypeError(f"outputs must be the loss, a tensor, got {type(outputs).__name__}")
        if outputs.numel() != 1 or not outputs.requires_grad:
            graph = "no graph" if not outputs.requires_grad else f"shape {list(outputs.shape)}"
            raise ValueError(f"outputs must be a loss of one element with a graph, got one with {graph}")
        self._outputs, self._inputs = outputs, _listed("inputs", inputs)
        if not self._inputs or not all(one.requires_grad for one in self._inputs):
            raise ValueError("inputs must be tensors that require grad")
        check_once(inputs=self._inputs)
        self.mode = mode
        N = sum(one.numel() for one in self._inputs)
        self.shape = (N, N)
        self.dtype, self.device = widest_type(self._inputs), self._inputs[0].device
        if mode == "exact":
            self._through = self._inputs
            found = _derivatives([outputs], self._inputs, None, create_graph=True)
            self._slopes = _or_zeros(found, self._inputs)
            self.gradient = flattened([one.detach() for one in self._slopes])
        else:
            if through is None:
                self._through = black_box_inputs(outputs)
            else:
                self._through = _listed("through", through)
                check_through(outputs, self._through)
            self._slopes = _grad([outputs], self._through, None, create_graph=True)
            found = _derivatives([outputs], self._inputs, None)
            self.gradient = flattened(_or_zeros(found, self._inputs))
        self.depends = any(one is not None for one in found)

    gradient: Tensor
    """Gradient of the loss, [N]."""
    depends: bool
    """Whether the loss is computed from any of the parameters."""

    @overload
    def __matmul__(self, v: Tensor) -> Tensor: ...
    @overload
    def __matmul__(self, v: Any) -> Any: ...
    def __matmul__(self, v: Any) -> Any:
        """Return H v for v [N], or H V for V [N, m]: a tensor, or for an array of NumPy an array of its type."""
        if isinstance(array := v, getattr(sys.modules.get("numpy"), "ndarray", ())):
            v = torch.as_tensor(array, device="cpu")
            return (self @ v.to(self.device)).to(v).numpy()
        if not isinstance(v, Tensor):
            raise TypeError(f"v must be a tensor [{self.shape[0]}], all inputs in one, got {type(v).__name__}")
        if v.dim() not in (1, 2) or len(v) != self.shape[0]:
            raise ValueError(f"v must have shape [{self.shape[0]}] or [{self.shape[0]}, m], got {list(v.shape)}")
        if v.dim() == 2:
            return torch.stack([self @ column for column in v.unbind(1)], 1) if v.shape[1] else v.clone()
        t = self._split(v)
        if self.mode == "exact":
            return flattened(_grad(self._curved, self._inputs, t))
        return self.pull(self.output_curvature(self.output_step(v)))

    def __repr__(self) -> str:
        return f"CurvatureOperator(mode={self.mode!r}, shape={self.shape}, dtype={self.dtype})"

    @property
    def inputs(self) -> list[Tensor]:
        """The parameters."""
        return self._inputs

    @property
    def through(self) -> list[Tensor]:
        """The tensors y at which the white box ends ("gauss_newton" only)."""
        return self._through

    @property
    def output_gradient(self) -> list[Tensor]:
        """dl/dy in the shapes of `through`, without a graph ("gauss_newton" only)."""
        return [one.detach() for one in self._slopes]

    def output_step(self, v: Tensor) -> list[Tensor]:
        """Return J v, how far the inputs of the black boxes move along v [N] ("gauss_newton" only)."""
        dummies, pulled = self._pulled
        return _grad(pulled, dummies, self._split(v))

    @cached_property
    def _pulled(self) -> tuple[list[Tensor], list[Tensor]]:
        """A dummy d and J^T d, which is linear in d: its transpose by a second backward pass is J."""
        check_twice(self._through, self._inputs)
        dummies = [torch.zeros_like(y, requires_grad=True) for y in self._through]
        return dummies, _grad(self._through, self._inputs, dummies, create_graph=True)

    @cached_property
    def _curved(self) -> list[Tensor]:
        """The first derivatives, with a graph that torch differentiates."""
        check_twice([self._outputs], self._through)
        return self._slopes

    def output_curvature(self, t: Sequence[Tensor]) -> list[Tensor]:
        """Return (d2l/dy2) t for vectors in the shapes of the inputs of the black boxes."""
        return _grad(self._curved, self._through, t)

    def pull(self, d: Sequence[Tensor]) -> Tensor:
        """Return J^T d, [N], for vectors d in the shapes of the inputs of the black boxes ("gauss_newton" only)."""
        return flattened(_grad(self._through, self._inputs, d))

    def to_dense(self) -> Tensor:
        """Return the matrix [N, N], one product per column; ValueError beyond 10 000 parameters."""
        if self.shape[0] > _DENSE:
            raise ValueError(f"to_dense would form a matrix of {self.shape[0]} squared numbers: use H @ v")
        return self @ torch.eye(self.shape[0], dtype=self.dtype, device=self.device)

    def _split(self, v: Tensor) -> list[Tensor]:
        parts = split_like(v.detach(), self._inputs)
        return [part.to(one.dtype) for part, one in zip(parts, self._inputs, strict=True)]


def hvp(
    outputs: Tensor,
    inputs: Tensor | Sequence[Tensor],
    v: Tensor | Sequence[Tensor],
    *,
    mode: str = "exact",
    through: Tensor | Sequence[Tensor] | None = None,
) -> Tensor | list[Tensor]:
    """Return the Hessian of a loss with respect to `inputs`, times v.

    v has the shape of `inputs`, a tensor or a sequence of tensors, and so has the result. The graph is kept. For `mode`
    and `through` see `CurvatureOperator`.

    Example:
        >>> w = torch.tensor([1.0, 2.0], requires_grad=True)
        >>> hvp((w**3).sum(), w, torch.tensor([0.0, 1.0]))
        tensor([ 0., 12.])
    """
    parts, vectors = _listed("inputs", inputs), _listed("v", v)
    if [one.shape for one in parts] != [one.shape for one in vectors]:
        raise ValueError(
            f"v must have the shapes of inputs, {[list(one.shape) for one in parts]}, "
            f"got {[list(one.shape) for one in vectors]}"
        )
    operator = CurvatureOperator(outputs, parts, mode=mode, through=through)
    result = split_like(operator @ flattened(vectors), parts)
    return result[0] if isinstance(inputs, Tensor) else result


def _listed(name: str, tensors: Tensor | Sequence[Tensor]) -> list[Tensor]:
    parts = list(tensors) if isinstance(tensors, Iterable) and not isinstance(tensors, Tensor) else [tensors]
    check_tensors(**{name: parts})
    return parts


def _grad(
    outputs: Sequence[Tensor], inputs: Sequence[Tensor], vectors: Sequence[Tensor] | None, *, create_graph: bool = False
) -> list[Tensor]:
    """Vector-Jacobian product that keeps the graph and gives zeros where nothing depends."""
    return _or_zeros(_derivatives(outputs, inputs, vectors, create_graph=create_graph), inputs)


def _or_zeros(found: Sequence[Tensor | None], inputs: Sequence[Tensor]) -> list[Tensor]:
    return [torch.zeros_like(one) if d is None else d for d, one in zip(found, inputs, strict=True)]


def _derivatives(
    outputs: Sequence[Tensor], inputs: Sequence[Tensor], vectors: Sequence[Tensor] | None, *, create_graph: bool = False
) -> Sequence[Tensor | None]:
    """Vector-Jacobian product that keeps the graph, with None where nothing depends."""
    pairs = [
        (output, None if vectors is None else vectors[index])
        for index, output in enumerate(outputs)
        if output.requires_grad
    ]
    if not pairs:
        return [None] * len(inputs)
    chosen, weights = zip(*pairs, strict=True)
    try:
        return torch.autograd.grad(
            chosen, inputs, weights, retain_graph=True, create_graph=create_graph, allow_unused=True
        )
    except RuntimeError as error:
        if "donated buffers" in str(error):  # memory that a compiled backward uses again
            raise RuntimeError(COMPILED) from error
        raise
