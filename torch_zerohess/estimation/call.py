"""How a black box is called: the function, where it runs, the head after it, and points without a value."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.arguments import check_bool, check_evaluator, check_head, checked_number
from torch_zerohess.estimation.advice import add_advice
from torch_zerohess.estimation.head import Head, apply_head
from torch_zerohess.estimation.inputs import all_finite, times_changed
from torch_zerohess.estimation.outer import Outer, outer_of
from torch_zerohess.estimation.rounding import RoundingCheck
from torch_zerohess.evaluators.batch import loss_error
from torch_zerohess.evaluators.evaluator import Evaluator
from torch_zerohess.evaluators.factory import Each
from torch_zerohess.evaluators.inline import Inline
from torch_zerohess.evaluators.payload import RemoteTraceback
from torch_zerohess.evaluators.single_nan import filled
from torch_zerohess.evaluators.values import checked_values

ValueMode = Literal["center", "smoothed"]


@dataclass(frozen=True)
class BlackBoxCall:
    """How to call a black box: the function, and what to do with what it returns.

    fn: [K, n], *aux [K, ...] -> [K, *out], or of one point [n] -> [*out] where not `vectorized`. Without aux if there
        is a head.
    head: white box after fn, see `estimation.head`; None: the outputs of fn are the values.
    joint: one evaluation takes a point of every batch element: [K, B, n], *aux [K, B, ...] -> [K, B, *out].
    on_nonfinite: "raise", "drop" (leave out the whole antithetic pair), or a number to put in its place.
    """

    fn: Callable[..., Any]
    vectorized: bool = True
    evaluator: Evaluator | None = None
    value: ValueMode = "center"
    on_nonfinite: str | float = "raise"
    head: Head | None = None
    joint: bool = False
    outer: Outer = field(init=False, repr=False, compare=False)
    """The function outside of the expectation of the values."""
    answered: bool = field(default=False, init=False, repr=False, compare=False)
    """Whether a call has given values."""
    latest: Tensor | None = field(default=None, init=False, repr=False, compare=False)
    """The latest outputs, without points: [0, *out]. None as long as no call has given outputs of several numbers."""
    rounding: RoundingCheck = field(default_factory=RoundingCheck, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not callable(self.fn):
            raise TypeError(f"fn must be callable, got {self.fn!r}")
        if self.evaluator is None:
            object.__setattr__(self, "evaluator", Inline())
        else:
            check_evaluator(self.evaluator)
        check_bool(vectorized=self.vectorized)
        object.__setattr__(self, "outer", outer_of(self.head))
        if self.outer.head is not None:
            check_head(self.outer.head)
        if self.value not in ("center", "smoothed"):
            raise ValueError(f"value must be 'center' or 'smoothed', got {self.value!r}")
        object.__setattr__(self, "on_nonfinite", _checked_rule(self.on_nonfinite))

    def __call__(self, points: Tensor, aux: Sequence[Tensor]) -> Tensor:
        """Return values [K, *out], a real floating tensor on the device of points [K, n]."""
        fn = self.fn if self.vectorized else Each(self.fn)
        assert self.evaluator is not None
        try:
            with torch.no_grad():
                result = self.evaluator(fn, points, *aux)
        except (IndexError, RuntimeError, TypeError, ValueError) as error:
            raised = isinstance(self.evaluator, Inline) or isinstance(error.__cause__, RemoteTraceback)
            if raised and not self.answered:
                headed = self.outer.head is not None
                add_advice(error, self.fn, points, aux, vectorized=self.vectorized, headed=headed)
            raise
        values = checked_values(result, points, self.vectorized)
        if values.ndim > 1:
            object.__setattr__(self, "latest", values[:0].clone())
        elif self.latest is not None:
            values = filled(values, self.latest)
        object.__setattr__(self, "answered", True)
        # A copy: the black box may go on writing to what it returned.
        return _copied(values) if values.device == points.device else values.to(points.device).contiguous()

    def separates(self, count: int) -> bool:
        """Return whether each of `count` points of a batch is a call of fn of its own."""
        return not self.vectorized or count <= max(getattr(self.evaluator, "single_points", 1), 1)

    def values(
        self,
        points: Tensor,
        aux: Sequence[Tensor],
        *,
        spare: bool = False,
        receive: Callable[[Tensor], None] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Return values [B, E, *out] at points [B, E, n] with aux [B, ...], and the outputs of fn [B, E, *outputs].

        Without a head they are the same.

        spare: nobody needs the points again; else the black box gets a copy, because it may write to its input.
        receive: called with the outputs before anything else can fail.
        """
        B, E = points.shape[:2]
        if self.joint:
            return (self._jointly(_copied(points.transpose(0, 1)), aux),) * 2
        flat = points.flatten(0, 1) if spare else _copied(points.flatten(0, 1))
        if self.outer.head is None:
            values = self(flat, [one.repeat_interleave(E, 0) for one in aux])
            values = values.reshape(B, E, *values.shape[1:])
            if receive:
                receive(values)
            self._lost(flat)
            return values, values
        outputs = self(flat, []).unflatten(0, (B, E))
        if receive:
            receive(outputs)
        before = times_changed(outputs)
        values, lost = apply_head(self.outer.head, outputs, aux), self._lost(flat)
        if times_changed(outputs) != before:
            raise ValueError("head must not change the outputs of the black box, which are kept: use a copy of them")
        if lost:  # a head may make a number of NaN
            values = values.clone()
            values[[k // E for k in lost], [k % E for k in lost]] = torch.nan
        if self.on_nonfinite == "raise" and aux and E > 1 and not all_finite(values):
            self._check_head(values, outputs)
        return values, outputs

    def _check_head(self, values: Tensor, outputs: Tensor) -> None:
        """Raise ValueError if no loss of an element is finite and its outputs are: its aux, or the head, is wrong."""
        sound = torch.isfinite(outputs.reshape(*outputs.shape[:2], -1)).all(2)
        wrong = (sound & ~torch.isfinite(values)).all(1)
        if bool(wrong.any()):
            b = int(wrong.nonzero()[0])
            raise ValueError(
                f"head returned {float(values[b, 0])} for every output of batch element {b}, and all these outputs are "
                f"finite: look at element {b} of aux for values that are not finite, or at the head"
            )

    def _jointly(self, points: Tensor, aux: Sequence[Tensor]) -> Tensor:
        """Return values [B, E, *out] of points [E, B, n], of which each row is one evaluation."""
        E, B = points.shape[:2]
        values = self(points, [_copied(one.expand(E, *one.shape)) for one in aux])
        if values.shape[1:2] != (B,):
            raise ValueError(
                f"fn must return one value per batch element, [{E}, {B}, *out] for points {list(points.shape)}, "
                f"got {list(values.shape)}"
            )
        self._lost(points.flatten(1))
        return values.transpose(0, 1)

    def _lost(self, points: Tensor) -> list[int]:
        """Return which of the points [K, n] of the last call the evaluator has no value of."""
        lost = getattr(self.evaluator, "lost", None) or {}
        if lost and self.on_nonfinite == "raise":
            raise loss_error(lost, points)
        return sorted(lost)

    def why_lost(self, E: int) -> Callable[[int, int], str | None]:
        """Return a function that says why the evaluator has no value of point e of element b, in the last call."""
        lost: dict[int, str] = getattr(self.evaluator, "lost", None) or {}
        return lambda b, e: lost.get(e if self.joint else b * E + e)


def _checked_rule(rule: Any) -> str | float:
    """Return `on_nonfinite`. TypeError if it is neither a text nor a number, ValueError if it is another one."""
    if isinstance(rule, str) and rule in ("raise", "drop"):
        return rule
    error: type[Exception] = ValueError
    try:
        if not isinstance(rule, str):
            return checked_number("on_nonfinite", rule, below=math.inf)
    except (TypeError, ValueError) as wrong:
        error = type(wrong)
    raise error(f"on_nonfinite must be 'raise', 'drop' or a finite number, got {rule!r}")


def _copied(tensor: Tensor) -> Tensor:
    """Return a contiguous copy: who gets it may write to it, and read it from its pointer."""
    return tensor.clone(memory_format=torch.contiguous_format)
