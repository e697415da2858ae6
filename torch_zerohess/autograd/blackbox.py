"""The drop-in layer: a function that can only be called, as a torch module with derivatives to second order."""

import functools
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import torch
from torch import Tensor, nn

from torch_zerohess.autograd import opaque, transforms
from torch_zerohess.autograd.closed_form import ClosedForm
from torch_zerohess.autograd.linear_map import first_order_only, project
from torch_zerohess.estimation.evaluation import BlackBoxCall, ValueMode, evaluate_center
from torch_zerohess.estimation.expansion import Expansion
from torch_zerohess.estimation.inputs import checked_input, folded_aux
from torch_zerohess.estimation.perturbations import stored
from torch_zerohess.evaluators.inline import Evaluator, Inline
from torch_zerohess.smoothing import Smoothing


class BlackBox(nn.Module):
    """A black box, convolved with a Gaussian, as a layer: F(x) = E fn(x + sigma u), u ~ N(0, I).

    One forward call is one batch of evaluations. Gradients, Hessians and Hessian-vector products, by any transform of
    torch, use that batch. If no derivative can be asked for (under `torch.no_grad`, or if x does not require grad),
    only f(x) is evaluated.

    Args:
        fn: [K, n], *aux [K, ...] -> [K, *out], scalar values (a loss) or tensors (an image). It may use NumPy,
            Mitsuba, another program; it gets detached tensors and is not differentiated. A module given as fn is not
            registered: its parameters are not trained through this layer.
        smoothing: how to sample; may be replaced between calls (`layer.smoothing = layer.smoothing.replace(...)`).
        vectorized: False if fn takes one point [n] at a time.
        evaluator: where evaluations run; in this process if None.
        value: "center" returns f(x), "smoothed" the estimate of F(x). Derivatives are derivatives of F in both cases.
        on_nonfinite: "raise", "drop" (with the other one of its pair), or a number that replaces NaN and infinities.

    Shapes: x [*batch, n], aux [*batch, ...] -> [*batch, *out], of the dtype and on the device of x.

    Example:
        >>> layer = BlackBox(lambda z: z.round().sum(1), Smoothing(sigma=1.0, samples=2000, seed=0))
        >>> x = torch.tensor([0.2, 0.7], requires_grad=True)
        >>> layer(x).backward()  # rounding has no gradient, its smoothed version has
        >>> bool((x.grad - 1).abs().max() < 0.1)
        True
    """

    smoothing: Smoothing

    def __init__(
        self,
        fn: Callable[..., Any],
        smoothing: Smoothing,
        *,
        vectorized: bool = True,
        evaluator: Evaluator | None = None,
        value: ValueMode = "center",
        on_nonfinite: str | float = "raise",
    ) -> None:
        super().__init__()
        if not isinstance(smoothing, Smoothing):
            raise TypeError(f"smoothing must be a Smoothing, got {type(smoothing).__name__}")
        self.smoothing = smoothing
        self.call = BlackBoxCall(fn, vectorized, evaluator or Inline(), value, on_nonfinite)
        self.output_shapes: dict[tuple[int | torch.Size, ...], torch.Size] = {}
        self._handle = opaque.register(self)

    def forward(self, x: Tensor, *aux: Tensor) -> Tensor:
        """Return values [*batch, *out] for x [*batch, n] and auxiliary inputs [*batch, ...]."""
        x = checked_input(x)
        if x.requires_grad and not transforms.watched(x) and not transforms.forward_mode_active():
            x = Input.apply(x)
        batch = x.shape[:-1]
        flat, others = x.reshape(-1, x.shape[-1]), folded_aux(_without_grad(aux), batch)
        if self.call.value == "center" and not transforms.derivative_possible(x):
            result = self._center(flat.detach(), others)
        else:
            result = _value(self._evaluate(flat.detach(), others), flat, flat.detach(), zero=True)
        if torch.compiler.is_compiling() and x.requires_grad:
            # torch differentiates a compiled backward a second time without an error, and gets a wrong number, unless
            # the backward has saved an input of the graph. This term is zero and saves x: now torch raises.
            result = result + 0.0 * x.sin().sum()
        return result.reshape((*batch, *result.shape[1:]))

    def freeze(self, x: Tensor, *aux: Tensor) -> Callable[[Tensor], Tensor]:
        """Evaluate around x [*batch, n] once and return the estimate as a function of x alone.

        The function re-weights the same evaluations to the density around its argument. Near x it estimates the
        smoothed black box and has derivatives of every order; it makes no further evaluation.
        """
        batch, n = checked_input(x).shape[:-1], x.shape[-1]
        center = x.detach().reshape(-1, n).clone()
        expansion = self._evaluate(center, folded_aux(_without_grad(aux), batch))

        def frozen(z: Tensor) -> Tensor:
            result = _value(expansion, z.reshape(-1, n), center, zero=False)
            return result.reshape((*batch, *result.shape[1:]))

        return frozen

    def _evaluate(self, x: Tensor, aux: list[Tensor]) -> Expansion:
        B, n = x.shape
        keep = torch.compiler.is_compiling() or stored(self.smoothing, B, n)
        if not transforms.watched(x):
            return opaque.expand(self, keep, x, aux)
        K = self.smoothing.evaluations(n, center=False)
        tensors = torch.ops.torch_zerohess.evaluate(self._handle, K, keep, x, aux)
        return Expansion.rebuild(tensors, x, self.smoothing, keep)

    def _center(self, x: Tensor, aux: list[Tensor]) -> Tensor:
        if transforms.watched(x):
            result: Tensor = torch.ops.torch_zerohess.evaluate_center(self._handle, x, aux)
            return result
        return evaluate_center(self.call, x, aux).to(x.dtype)

    @property
    def fn(self) -> Callable[..., Any]:
        """The black box itself."""
        return self.call.fn

    def get_extra_state(self) -> dict[str, Any]:
        """Return the settings, so that a state_dict resumes an annealed sigma."""
        return {one.name: getattr(self.smoothing, one.name) for one in fields(Smoothing)}

    def set_extra_state(self, state: dict[str, Any]) -> None:
        self.smoothing = Smoothing(**state)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._handle = opaque.register(self)  # a copy serves its own calls

    def extra_repr(self) -> str:
        return f"{getattr(self.call.fn, '__name__', self.call.fn)!s}, {self.smoothing}"


class Input(torch.autograd.Function):
    """The identity. It marks in the graph where a black box begins: see `curvature.black_box_inputs`."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.save_for_backward(x)
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        return gradient


def smooth(
    fn: Callable[..., Any],
    smoothing: Smoothing,
    *,
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    value: ValueMode = "center",
    on_nonfinite: str | float = "raise",
) -> Callable[..., Tensor]:
    """Return fn, convolved with a Gaussian, as a differentiable function of a tensor: `BlackBox` without the module.

    Arguments, shapes and errors: see `BlackBox`.

    Example:
        >>> f = smooth(lambda z: (z > 0).double().sum(1), Smoothing(sigma=0.5, samples=4000, seed=0))
        >>> slope = torch.func.grad(f)(torch.zeros(1, dtype=torch.float64))  # density of N(0, 0.5^2) at 0
        >>> bool((slope - 0.7979).abs() < 0.05)
        True
    """
    return BlackBox(fn, smoothing, vectorized=vectorized, evaluator=evaluator, value=value, on_nonfinite=on_nonfinite)


def _value(expansion: Expansion, x: Tensor, center: Tensor, *, zero: bool) -> Tensor:
    """Return the expansion around `center` at x [B, n], with a graph; `zero` says that x equals `center` in value."""
    if zero and not transforms.watched(x) and not transforms.forward_mode_active():
        result: Tensor = ClosedForm.apply(
            x, expansion, functools.partial(_general, expansion, center=center, zero=True)
        )
        return result
    return _general(expansion, x, center=center, zero=zero)


def _general(expansion: Expansion, x: Tensor, *, center: Tensor, zero: bool) -> Tensor:
    stein, c = expansion.stein, expansion.flat

    def ratios(d: Tensor, zero: bool) -> Tensor:
        d = first_order_only(d) if stein.first_order else d
        return (stein.ratio(d, functools.partial(project, zero=zero))[:, None] @ c)[:, 0]

    d = (x.double() - center.double()) / expansion.sigma
    total = ratios(d, zero)
    change = total - (total if zero else ratios(torch.zeros_like(d), True)).detach()
    return (expansion.base + change.reshape(expansion.base.shape)).to(x.dtype)


def _without_grad(aux: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    for number, one in enumerate(aux):
        if isinstance(one, Tensor) and transforms.derivative_wanted(one):
            raise ValueError(
                f"aux[{number}] requires grad, but the black box is differentiated with respect to x alone: "
                "pass it detached, or as part of x"
            )
    return aux
