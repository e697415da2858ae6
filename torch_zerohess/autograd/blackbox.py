"""The drop-in layer: a function that can only be called, as a torch module with derivatives to second order."""

import contextlib
import copy
import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from torch_zerohess.autograd import control_variate, opaque, tracing, transforms
from torch_zerohess.autograd.captured import warn_of_captured
from torch_zerohess.autograd.closed_form import ClosedForm
from torch_zerohess.autograd.expanded import general, tangent
from torch_zerohess.autograd.layer import Layer
from torch_zerohess.autograd.marker import Input
from torch_zerohess.estimation.call import BlackBoxCall, ValueMode
from torch_zerohess.estimation.control import Control
from torch_zerohess.estimation.expansion import Expansion
from torch_zerohess.estimation.head import Head
from torch_zerohess.estimation.inputs import check_aux, checked_input, folded_aux, working
from torch_zerohess.estimation.perturbations import stored
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.smoothing import Smoothing
from torch_zerohess.surrogates.memory import Memory, check_memory


class BlackBox(Layer):
    """A black box, convolved with a Gaussian, as a layer: F(x) = E fn(x + sigma u), u ~ N(0, I).

    One forward call is one batch of evaluations. Gradients, Hessians and Hessian-vector products, by any transform of
    torch, use that batch. If no derivative can be asked for (under `torch.no_grad`, or if x does not require grad),
    only f(x) is evaluated.

    Args:
        fn: [K, n], *aux [K, ...] -> [K, *out], scalar values (a loss) or tensors (an image). It may use NumPy,
            Mitsuba, another program; it gets detached, contiguous tensors and is not differentiated. A module given as
            fn is not registered: its parameters are not trained through this layer. Other tensors that fn captures
            have no derivatives, either: UserWarning if they are differentiated.
        head: white box after fn, `head(outputs [K, *out], *aux [K, ...]) -> [K]`, made of differentiable torch
            operations. fn then gets points alone, so that one output serves every aux; aux is not copied per sample,
            and head must not change it. Parameters and other tensors in it are constants: they must not require grad,
            except under `torch.no_grad`. A module given as head is not registered. What is trained belongs behind a
            layer without a head. There, derivatives of a nonlinear loss are biased: the second ones always, the first
            ones with value="smoothed", and with a memory whose `fresh` is less than the batch.
        memory: keeps evaluations and subtracts what its surrogate explains, see `Memory`. fn gets points alone. In
            training mode evaluations are kept and the surrogate is fitted to them; after `eval()` both stay as they
            are, and so does the coefficient: 0 until a call has learned it. Under `torch.no_grad` f(x) alone is
            evaluated, and not kept, unless value="smoothed". Calls of several threads with one memory take turns.
        smoothing: how to sample. This and `value` may be set between calls: `layer.smoothing = Smoothing(...)`.
        vectorized: False if fn takes one point [n] at a time.
        evaluator: where evaluations run; in this process if None.
        value: "center" returns f(x), "smoothed" the estimate of F(x). Derivatives are of F in both cases, see `head`.
        on_nonfinite: "raise", "drop" (with the other one of its pair), or a number that replaces NaN and infinities.
            "drop" is unbiased only where fn fails at random, not where it fails in a region.

    Shapes: x [*batch, n], aux [*batch, ...] -> [*batch, *out], of the dtype and on the device of x. For x and aux in
    float16 or bfloat16, as autocast makes them, fn and head get float32, and losses of a head stay float32, as losses
    of torch do. Autocast is off while fn, head and surrogate run: its rounding is larger than the differences that
    derivatives are made of.

    A batch without points, [0, n], gives an empty result and zero gradients, without a call of fn. Without a head
    the shape of one output must be known, from an earlier call or the memory, else ValueError.

    Under `torch.func.vmap` the noise is independent for each point that is mapped over, as in a batch. So vmap works as
    with randomness="different", and does not raise with its default, "error". With seed=None, "same" raises ValueError,
    and so does "different" where neither x nor aux is mapped over.

    `state_dict` has all settings of the smoothing, not sigma alone, and the contents of the memory, as one tensor of
    bytes. `load_state_dict` replaces the settings that the layer was made with, so set others after it:
    `layer.smoothing = layer.smoothing.replace(samples=16)`. A state without a memory leaves the memory of the layer as
    it is. A layer without a memory takes the settings alone with strict=False; otherwise such a state is an error.

    Every layer has a compiled graph of its own. `torch.compile` makes at most 8 of one function in one process, its
    `recompile_limit`, layers that no longer live included. Layers of one model are one graph. Beyond 8 models use
    `torch.compile(model, isolate_recompiles=True)`, or set a higher limit for torch without it. A graph serves every
    seed and sigma, but one number of samples. With the ninth number fullgraph=True raises FailOnRecompileLimitHit.
    Without fullgraph torch logs a warning, and the layer runs without a graph for further numbers. Either way, a higher
    `recompile_limit` helps, isolate_recompiles does not. A layer with a memory is called between graphs: fullgraph=True
    is an error, and so is `torch.func.grad` inside of compiled code. `torch.func.hessian` and other second derivatives
    can be compiled, but not forward mode of forward mode: fullgraph=True is an error, and without it no graph is made.
    `torch.export` and `torch.jit.trace` raise RuntimeError: no file holds a black box.

    Example:
        >>> layer = BlackBox(lambda z: z.round().sum(1), Smoothing(sigma=1.0, samples=2000, seed=0))
        >>> x = torch.tensor([0.2, 0.7], requires_grad=True)
        >>> layer(x).backward()  # rounding has no gradient, its smoothed version has
        >>> bool((x.grad - 1).abs().max() < 0.1)
        True
    """

    def __init__(
        self,
        fn: Callable[..., Any],
        smoothing: Smoothing,
        *,
        head: Head | None = None,
        memory: Memory | None = None,
        vectorized: bool = True,
        evaluator: Evaluator | None = None,
        value: ValueMode = "center",
        on_nonfinite: str | float = "raise",
    ) -> None:
        super().__init__()
        self.smoothing = smoothing
        check_memory(memory)
        self.call = BlackBoxCall(fn, vectorized, evaluator, value, on_nonfinite, head)
        warn_of_captured(fn, head)
        self.memory = memory
        self.control: Control | None = None
        """The memory during the present call."""
        self.output_shapes: dict[tuple[int | torch.Size, ...], torch.Size] = {}
        self._handle = opaque.register(self)

    @property
    def value(self) -> ValueMode:
        """What the layer returns: "center" or "smoothed"."""
        return self.call.value

    @value.setter
    def value(self, value: ValueMode) -> None:
        self.call = replace(self.call, value=value)

    def forward(self, x: Tensor, *aux: Tensor) -> Tensor:
        """Return values [*batch, *out] for x [*batch, n] and auxiliary inputs [*batch, ...]."""
        tracing.check_traceable()
        if torch.compiler.is_compiling() and (self.memory is not None or not tracing.GRAPHS):
            from torch_zerohess.autograd.in_graph import eager  # loaded late, as there

            return eager(self, x, *aux)
        tracing.check_derivatives()
        dtype, x = self._dtype(checked_input(x, empty=True)), working(x)
        check_aux(aux, self.memory, self.call.head)
        batch, n = x.shape[:-1], x.shape[-1]
        center, others = x.detach().reshape(batch.numel(), n), folded_aux(_without_grad(aux), batch)
        if len(center) and self.call.value == "center" and not transforms.derivative_possible(x):
            result = self._center(center, others)
            return result.reshape((*batch, *result.shape[1:])).to(dtype)
        watched = transforms.watched(x)
        alone = self.memory is None and self.call.outer.linear
        if len(center) and alone and not watched and not transforms.forward_mode_active():
            expansion = self._evaluate(center, others)
            settings = self.smoothing.resolved(n)
            result = ClosedForm.apply(x, expansion, settings, stored(settings, len(center), n), general)
            return result.to(dtype)
        if x.requires_grad and not watched and not transforms.has_tangent(x):
            x = Input.apply(x)
        if not len(center):
            return opaque.empty(self, x, others).to(dtype)
        if self.memory is None:
            result = self._around(center, others)(x.reshape(-1, n))
        else:
            with self.memory.lock:  # the surrogate stays the same until the result is there
                result = self._around(center, others)(x.reshape(-1, n))
        if torch.compiler.is_compiling() and x.requires_grad:
            # torch differentiates a compiled backward a second time without an error, and gets a wrong number, unless
            # the backward has saved an input of the graph. This term is zero and saves x: now torch raises.
            result = result + 0.0 * x.sin().sum()
        return result.reshape((*batch, *result.shape[1:])).to(dtype)

    def freeze(self, x: Tensor, *aux: Tensor) -> Callable[[Tensor], Tensor]:
        """Evaluate around x [*batch, n] once and return the estimate as a function of x alone.

        The function re-weights the same evaluations to the density around its argument. Near x it estimates the
        smoothed black box and has derivatives of every order. With proposal "optimal" it is an expansion about x:
        quadratic, affine with order=1 or "fr22". Higher derivatives raise ValueError. Nothing more is evaluated.
        """
        tracing.check_traceable()
        batch, n = checked_input(x).shape[:-1], x.shape[-1]
        center = working(x).detach().reshape(-1, n).clone()
        check_aux(aux, self.memory, self.call.head)
        # With grad: the function may be differentiated elsewhere, and a head must be a constant there.
        with torch.enable_grad(), contextlib.nullcontext() if self.memory is None else self.memory.lock:
            copies = [one.clone() for one in folded_aux(_without_grad(aux), batch)]  # the caller may write to them
            around = self._around(center, copies, zero=False)

        def frozen(z: Tensor) -> Tensor:
            if z.shape != (*batch, n):  # not x, which would keep its graph
                raise ValueError(f"x must have the shape {[*batch, n]} that was frozen, got {list(z.shape)}")
            result = around(working(z).reshape(-1, n)).to(self._dtype(z))
            return result.reshape((*batch, *result.shape[1:]))

        return frozen

    def _dtype(self, x: Tensor) -> torch.dtype:
        """Type of the result: that of x, but losses are not rounded to a half one."""
        return x.dtype if self.call.head is None else working(x).dtype

    def _around(self, center: Tensor, aux: list[Tensor], *, zero: bool = True) -> Callable[[Tensor], Tensor]:
        """Evaluate around a center [B, n], and return the estimate as a function of x [B, n].

        zero: promises that x equals the center in value, and that the function is called before the surrogate changes.
        """
        if self.memory is None:
            estimated, constants = self._estimated(center, aux, zero)
            around = None if zero else estimated(center).detach()
            return lambda x: self.call.outer.value(estimated(x), constants, self.call.value, around)
        self.memory.check_parameters(center.shape[1])
        tracing.check_not_recorded([center, *aux])
        with transforms.outside(), transforms.random_numbers_allowed(), transforms.unrecorded():
            self.control = Control.of(self.memory, self.call.outer, learning=self.training)
            seed = self.smoothing.drawn_seed(self.control.taken)
        try:
            return control_variate.Around(
                control=self.control,
                surrogate=self.memory.surrogate if zero else copy.deepcopy(self.memory.surrogate),
                center=center,
                aux=aux,
                sigma=self.smoothing.sigma_vector(center.shape[1], center.device),
                seed=seed,
                order=self.smoothing.order,
                value=self.call.value,
                zero=zero,
                nodes=lambda count: opaque.nodes(self._handle, seed, count, center, aux),
                estimated=lambda part, its_aux: self._estimated(part, its_aux, zero),
            ).evaluated()
        finally:
            self.control = None

    def _estimated(self, center: Tensor, aux: list[Tensor], zero: bool) -> tuple[Callable[[Tensor], Tensor], Tensor]:
        """Return the expectation that new evaluations estimate, as `_around` does, and its constants."""
        expansion = self._evaluate(center, aux)
        active = self.control is not None and self.control.active
        if active and self.memory is not None and self.memory.order == 1:
            return functools.partial(tangent, expansion, center=center), expansion.constants
        return functools.partial(general, expansion, center=center, zero=zero), expansion.constants

    def _evaluate(self, x: Tensor, aux: list[Tensor]) -> Expansion:
        B, n = x.shape
        if not transforms.watched(x):
            return opaque.expand(self, stored(self.smoothing, B, n), x, aux)
        x = opaque.noise_checked(self._handle, x, aux)
        keep = torch.compiler.is_compiling() or stored(self.smoothing, B * transforms.mapped_size([x, *aux]), n)
        K = self.smoothing.evaluations(n, center=False)
        with contextlib.nullcontext() if transforms.recorded([x, *aux]) else transforms.unrecorded():
            tensors = torch.ops.torch_zerohess.evaluate(self._handle, K, keep, torch.is_grad_enabled(), x, aux)
        return Expansion.rebuild(tensors, x, self.smoothing if keep else self.smoothing.resolved(n), keep)

    def _center(self, x: Tensor, aux: list[Tensor]) -> Tensor:
        if transforms.watched(x):
            result: Tensor = torch.ops.torch_zerohess.evaluate_center(self._handle, torch.is_grad_enabled(), x, aux)
            return result
        return opaque.center(self, x, aux)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)  # type: ignore[no-untyped-call]
        self._handle = opaque.register(self)  # a copy serves its own calls


def smooth(
    fn: Callable[..., Any],
    smoothing: Smoothing,
    *,
    head: Head | None = None,
    memory: Memory | None = None,
    vectorized: bool = True,
    evaluator: Evaluator | None = None,
    value: ValueMode = "center",
    on_nonfinite: str | float = "raise",
) -> BlackBox:
    """Return fn, convolved with a Gaussian, as a differentiable function of a tensor: a `BlackBox` of fn.

    Arguments, shapes and errors: see `BlackBox`.

    Example:
        >>> f = smooth(lambda z: (z > 0).double().sum(1), Smoothing(sigma=0.5, samples=4000, seed=0))
        >>> slope = torch.func.grad(f)(torch.zeros(1, dtype=torch.float64))  # density of N(0, 0.5^2) at 0
        >>> bool((slope - 0.7979).abs() < 0.05)
        True
    """
    return BlackBox(
        fn,
        smoothing,
        head=head,
        memory=memory,
        vectorized=vectorized,
        evaluator=evaluator,
        value=value,
        on_nonfinite=on_nonfinite,
    )


def _without_grad(aux: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
    for number, one in enumerate(aux):
        if isinstance(one, Tensor) and transforms.derivative_wanted(one):
            raise ValueError(
                f"aux[{number}] requires grad, but the black box is differentiated with respect to x alone: "
                "pass it detached, or as part of x"
            )
    return aux
