"""One batch of black-box evaluations: the points, the call, the checks, and the coefficients of the Stein sums."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from torch import Tensor

from torch_zerohess.estimation.expansion import Expansion
from torch_zerohess.estimation.perturbations import draws, perturb
from torch_zerohess.estimation.stein import Stein, total
from torch_zerohess.evaluators.inline import Evaluator, Inline
from torch_zerohess.smoothing import Smoothing

ValueMode = Literal["center", "smoothed"]


@dataclass(frozen=True)
class BlackBoxCall:
    """How to call a black box: the function, and what to do with what it returns.

    fn: [K, n], *aux [K, ...] -> [K, *out], or of one point [n] -> [*out] where not `vectorized`.
    on_nonfinite: "raise", "drop" (leave out the whole antithetic pair), or a number to put in its place.
    """

    fn: Callable[..., Any]
    vectorized: bool = True
    evaluator: Evaluator = field(default_factory=Inline)
    value: ValueMode = "center"
    on_nonfinite: str | float = "raise"

    def __post_init__(self) -> None:
        if not callable(self.fn):
            raise TypeError(f"fn must be callable, got {self.fn!r}")
        if self.value not in ("center", "smoothed"):
            raise ValueError(f"value must be 'center' or 'smoothed', got {self.value!r}")
        rule = self.on_nonfinite
        number = isinstance(rule, (int, float)) and not isinstance(rule, bool) and math.isfinite(rule)
        if not number and rule not in ("raise", "drop"):
            raise ValueError(f"on_nonfinite must be 'raise', 'drop' or a finite number, got {rule!r}")

    def __call__(self, points: Tensor, aux: Sequence[Tensor]) -> Tensor:
        """Return values [K, *out], a real floating tensor on the device of points [K, n]."""
        fn = self.fn if self.vectorized else self._each
        values = _tensor(self.evaluator(fn, points, *aux))
        if values.requires_grad:
            raise ValueError("fn returned a tensor that requires grad; a black box has no graph: return it detached")
        if not values.is_floating_point():
            raise TypeError(f"fn must return real floating-point values, got {values.dtype}: convert, e.g. .float()")
        if values.dim() == 0 or len(values) != len(points):
            raise ValueError(
                f"fn must return one value per point, [{len(points)}, *out] for points "
                f"{list(points.shape)}, got {list(values.shape)}"
                + ("" if self.vectorized else " from single points")
                + ("; for a function of one point pass vectorized=False" if self.vectorized else "")
            )
        return values.to(points.device, copy=True)  # the black box may go on writing to what it returned

    def _each(self, points: Tensor, *aux: Tensor) -> Tensor:
        return torch.stack([_tensor(self.fn(*one)) for one in zip(points, *aux, strict=True)])


@dataclass(frozen=True)
class Evaluations:
    """One call of the black box: its points and values, and the expansion made of them.

    Shapes: B batch, K perturbations, n parameters.
    """

    points: Tensor
    """Perturbed points [B, K, n], in the dtype of x."""
    values: Tensor
    """Values there, [B, K, *out], as the black box returned them; zero where they were dropped."""
    center: Tensor | None
    """f(x), [B, *out], where it was evaluated."""
    share: Tensor
    """Weight of each row in a mean, [B, K]: 1/K; where rows were dropped, zero for them and more for the others."""
    expansion: Expansion

    @property
    def dropped(self) -> int:
        """Evaluations left out because they, or the other one of their pair, were not finite."""
        return int((self.share == 0).sum())


def evaluate(call: BlackBoxCall, x: Tensor, aux: Sequence[Tensor], smoothing: Smoothing, keep: bool) -> Evaluations:
    """Draw perturbations of x [B, n] and call the black box once, on all of them and on x itself where it is needed.

    aux: [B, ...] each, repeated for every point of its batch element; keep: see `perturb`.
    """
    seed = int(torch.randint(2**63 - 1, ())) if smoothing.seed is None else smoothing.seed
    perturbations = perturb(x, smoothing, seed, keep)
    points, stein = perturbations.points, perturbations.stein
    B, K, n = points.shape
    with_center = call.value == "center" or smoothing.baseline == "center"
    everywhere = torch.cat([points, x[:, None]], 1) if with_center else points
    repeated = [one.repeat_interleave(everywhere.shape[1], 0) for one in aux]
    # A copy where there is none yet: the black box may write to its input.
    flat = everywhere.flatten(0, 1) if with_center else everywhere.flatten(0, 1).clone()
    values = call(flat, repeated).unflatten(0, (B, -1))
    values, kept = _finite(values, everywhere, call.on_nonfinite, K, smoothing, stein)
    center = values[:, K] if with_center else None
    values = values[:, :K]
    share = torch.full((B, K), 1.0 / K, dtype=torch.float64, device=x.device)
    if kept is not None:
        share = kept / kept.sum(1, keepdim=True).double()
    baseline, coefficients = _coefficients(values.reshape(B, K, -1), center, share[..., None], smoothing, n)
    if call.value == "center" and center is not None:
        base = center.double()
    else:
        base = stein.smoothed(values.reshape(B, K, -1), baseline, coefficients.mT).reshape((B, *values.shape[2:]))
    expansion = Expansion(base, coefficients.reshape(values.shape), perturbations.sigma, stein)
    return Evaluations(points, values, center, share, expansion)


def evaluate_center(call: BlackBoxCall, x: Tensor, aux: Sequence[Tensor]) -> Tensor:
    """Return f(x), [B, *out], for x [B, n]: one evaluation per batch element and nothing else."""
    values = call(x.clone(), [one.clone() for one in aux])
    bad = ~torch.isfinite(values.reshape(len(x), -1)).all(1)
    if bool(bad.any()):
        values = _replaced(values, bad.nonzero()[0], x, call.on_nonfinite)
    return values


def _coefficients(
    values: Tensor, center: Tensor | None, share: Tensor, smoothing: Smoothing, n: int
) -> tuple[Tensor, Tensor]:
    """Return the mean baseline [B, P] and (f - baseline) * share [B, K, P], for values [B, K, P], share [B, K, 1]."""
    f = values.double()
    if smoothing.baseline == "none":
        return torch.zeros_like(f[:, 0]), f * share
    if smoothing.baseline == "center" and center is not None:
        mean = center.double().reshape(len(f), -1)
        return mean, (f - mean[:, None]) * share
    baseline = _mean_of_others(f, share, draws(smoothing, n))
    return total(baseline * share)[:, 0], (f - baseline) * share


def _mean_of_others(f: Tensor, share: Tensor, draws: list[Tensor]) -> Tensor:
    """Mean over the rows of all other independent draws: a baseline that no row's own value enters.

    f: [B, K, P]; share: [B, K, 1], zero for dropped rows; draws: rows [D, r] of the draws, by size.
    """
    if sum(len(part) for part in draws) < 2:
        raise ValueError(
            "baseline 'mean' needs at least two independent draws to leave one out: use more samples (an even number "
            "for sampler 'sobol'), or baseline 'center'"
        )
    # Differences to one of the values keep the precision of a small variation on a large offset.
    origin = f[:, :1]
    shifted = (f - origin) * share
    whole, result = total(shifted), torch.empty_like(f)
    for part in draws:
        index = part.to(f.device)
        own, own_share = shifted[:, index].sum(2), share[:, index].sum(2)
        if bool((own_share > 1.0 - 1e-12).any()):
            raise ValueError("on_nonfinite='drop' left one independent draw, baseline 'mean' needs two: use 'center'")
        others = (whole - own) / (1.0 - own_share)
        result[:, index] = others[:, :, None].expand(-1, -1, part.shape[1], -1)
    return origin + result


def _finite(
    values: Tensor, points: Tensor, on_nonfinite: str | float, K: int, smoothing: Smoothing, stein: Stein
) -> tuple[Tensor, Tensor | None]:
    """Treat values [B, E, *out] that are not finite at points [B, E, n].

    Returns the values, and which of the K perturbed rows are kept, [B, K], or None if all are.
    """
    if math.isfinite(float(values.sum())):  # it is not, if one of them is not
        return values, None
    bad = ~torch.isfinite(values.reshape(*points.shape[:2], -1)).all(2)
    if not bool(bad.any()):
        return values, None
    if on_nonfinite != "drop" or bool(bad[:, K:].any()):
        where = bad.nonzero()[0]
        if on_nonfinite == "drop":  # the center cannot be dropped
            where = torch.tensor([int(bad[:, K].nonzero()[0]), K])
        rule = "raise" if on_nonfinite == "drop" else on_nonfinite
        return _replaced(values, where, points, rule), None
    kept = ~bad[:, :K]
    if smoothing.antithetic:
        pair = kept[:, : K // 2] & kept[:, K // 2 :]
        kept = torch.cat([pair, pair], 1)
    fewest = 2 if smoothing.baseline == "mean" else 1
    left = int(kept.sum(1).min()) // (2 if smoothing.antithetic else 1)
    if left < fewest:
        raise ValueError(
            f"on_nonfinite='drop' left {left} of {smoothing.samples} draws, {fewest} are needed: fn is not finite "
            "almost everywhere around x"
        )
    if not stein.droppable:
        raise ValueError(
            f"on_nonfinite='drop' cannot re-weight the element-wise sets of proposal {smoothing.proposal!r}: give a "
            "number to put in place of values that are not finite"
        )
    return torch.where(bad.reshape(*bad.shape, *[1] * (values.dim() - 2)), 0.0, values), kept


def _replaced(values: Tensor, where: Tensor, points: Tensor, rule: str | float) -> Tensor:
    """Put the number `rule` in place of values that are not finite, or raise for the first one, at index `where`."""
    if isinstance(rule, str):
        point = points[tuple(where.tolist())]
        text = ", ".join(f"{float(p):.6g}" for p in point[:8]) + (", ..." if len(point) > 8 else "")
        value = values[tuple(where.tolist())]
        wrong = float(value.flatten()[~torch.isfinite(value.flatten())][0])
        raise ValueError(
            f"fn returned {wrong} at the point [{text}]; choose on_nonfinite='drop' or a number to go on without it"
        )
    # float64, because the number may not exist in the dtype of fn: 1e6 is infinite in float16.
    return torch.where(torch.isfinite(values), values.double(), float(rule))


def _tensor(result: Any) -> Tensor:
    try:
        # A number of Python is float64, whatever the default dtype of torch.
        return torch.as_tensor(result, dtype=torch.float64 if isinstance(result, float) else None)
    except (TypeError, ValueError, RuntimeError) as error:
        raise TypeError(f"fn must return a tensor or a NumPy array, got {type(result).__name__}") from error
