"""Noise of a black box: how much repeated values differ, and which of several points has the lowest mean."""

import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

REPEATED = 8
"""Values at one point that measure the standard deviation of noise."""
_AGAIN = 2
"""Further evaluations of x where losses are counts: one would be equal to the first too often."""
_TWO = 6
"""Further evaluations of x where there are only two different losses, as of success and failure. Many of them are equal
by chance."""
_ROUNDING = 1e-6
"""Difference of two values, relative to them, that is rounding: renders of one seed differ by 3e-8."""
_BATCHED = 1e-3
"""The same for a value of a call of several points: sums in float32 are rounded in another way there."""
_SHARE, _MOST, _LEAST = 8, 48, 4
"""The part of all evaluations that the decision at the end gets: one in so many, at most and at least so many."""
_SIGNIFICANT = 3.0
"""Standard errors by which a deviation must be below noise. They are errors for Gaussian noise; the deviation of few
values of skewed noise is that small more often."""
_CONTRADICTION = 3.0
"""Standard errors by which a mean must be below the mean of a point that is trusted: several points are compared."""
_DOUBT = 2.0
"""Standard errors by which another mean must be below that of the chosen point to get the last evaluations, and to be
chosen with them."""


def differs(one: Tensor, other: Tensor, rounding: float = _ROUNDING) -> bool:
    """Whether two values [*out] of one point differ by more than rounding."""
    return float((one - other).abs().max()) > rounding * float(torch.maximum(one.abs(), other.abs()).max())


def is_rounding(values: Tensor) -> bool:
    """Whether values [K, *out] of one point have no noise: only the first one, of a call of several points, differs.

    False for fewer than three values, which show nothing.
    """
    if len(values) < 3:
        return False
    alone = values[1]
    return not differs(values[0], alone, _BATCHED) and not any(differs(one, alone) for one in values[2:])


def are_counts(losses: Tensor) -> bool:
    """Whether losses [K] are whole numbers, or at most three quarters of them are distinct."""
    losses = losses[torch.isfinite(losses)]
    return bool((losses == losses.round()).all()) or 4 * len(losses.unique()) <= 3 * len(losses)


def deviation(losses: Tensor) -> float:
    """Standard deviation of the finite losses [K] at one point; 0 if there is only one."""
    finite = losses[torch.isfinite(losses)]
    if len(finite) < 2:
        return 0.0
    size = float(finite.abs().max()) or 1.0  # squares of losses / size neither overflow nor vanish
    return float((finite / size).std()) * size


def noise_at(
    x: Tensor, points: Tensor, losses: Tensor, begun: int, evaluate: Callable[[Tensor], Tensor], most: int
) -> float | None:
    """Evaluate x again; return the deviation of its losses, 0 if they are equal, None if x has no loss.

    Losses that are counts may be equal by chance: these are compared with two further ones, others with one. If there
    are only two different losses, they are compared with six. A difference counts if it is more than rounding of the
    first loss, see `is_rounding`.

    Args:
        x: [n].
        points: all evaluations [P, n], in order.
        losses: [P].
        begun: number of evaluations before. Later ones are of an interrupted look, and are used again.
        evaluate: points [K, n] -> losses [K].
        most: how many further evaluations there may be.
    """
    before, known = losses[:begun][(points[:begun] == x).all(1)], losses[begun:]
    if not len(before) or not bool(torch.isfinite(before[-1])):
        return None
    few, most = _AGAIN if are_counts(losses[:begun]) else 1, most + len(known)
    if few > 1 and len(losses[:begun][torch.isfinite(losses[:begun])].unique()) <= 2:
        few = _TWO
    size = float(torch.stack([losses[torch.isfinite(losses)][0], before[-1]]).abs().max())
    again = known[:0]
    for count in (few, max(few, _AGAIN), REPEATED):
        wanted = min(count, most) - len(known)
        known = torch.cat([known, evaluate(x.expand(wanted, -1))]) if wanted > 0 else known
        again = known[:count][torch.isfinite(known[:count])]
        apart = (again - before[-1]).abs()
        if not len(again) or float(apart[:few].max()) <= _ROUNDING * size:
            return 0.0
        alike = len(again) > 1 and float(again.max() - again.min()) <= _ROUNDING * size
        if alike and float(apart.max()) <= _BATCHED * size:
            return 0.0
    return deviation(torch.cat([before, again]))


def opening(batch: int, least: int, most: int) -> int:
    """Return how many points there may be in a first batch that measures noise, besides the start again.

    A batch that takes all evaluations would leave none for that. It is shorter, and a second one follows anyway: so it
    leaves what noise and the decision at the end need, too.

    Args:
        batch: points that are evaluated at once.
        least: points that the search needs.
        most: evaluations that there may be.
    """
    return most if batch + 1 < most else max(least, most - REPEATED - reserved(most))


def reserved(evaluations: int) -> int:
    """Return how many evaluations a search in noise reserves for the decision at its end."""
    return min(max(evaluations // _SHARE, _LEAST), _MOST)


def distinct(points: Sequence[Tensor]) -> Tensor:
    """Return the points [C, n] without duplicates, in order."""
    chosen: list[Tensor] = []
    for one in points:
        if not any(torch.equal(one, other) for other in chosen):
            chosen.append(one)
    return torch.stack(chosen)


def lowest_mean(
    evaluate: Callable[[Tensor], Tensor], points: Tensor, evaluations: int, noise: float, *, trusted: bool = False
) -> tuple[int, float, float] | None:
    """Evaluate points [C, n] again; return which has the lowest mean, and its mean and standard error.

    The first half of the evaluations chooses: all remaining points get the same number, then the better half remains
    (successive halving: Karnin, Koren and Somekh 2013). The second half are at the chosen point. After half of these,
    the best of the other points is compared again. If its mean is lower by two standard errors, it gets the rest. If
    that is so with the rest, too, it is chosen.

    Only the second half enters the mean, because the values by which a point was chosen are too low on average. If no
    value of the second half is finite, the mean is over the first half; None if no value of the first half is finite,
    either.

    Args:
        evaluate: points [K, n] -> losses [K].
        points: to choose from.
        evaluations: how many may be made.
        noise: standard deviation of a loss. What is measured at the chosen point takes its place if that is larger, or
            significantly smaller: a loss of noisy outputs has less noise where it is lower.
        trusted: whether a model of many evaluations has chosen the first point. Another point then takes its place only
            if the mean is lower by three standard errors of the difference, see `_bound`.
    """
    left, choosing = torch.arange(len(points), device="cpu"), evaluations // 2
    losses = torch.zeros(len(points), 0, dtype=torch.float64, device="cpu")  # of those that are left
    rounds, rival = math.ceil(math.log2(len(points))), None
    for k in range(rounds):
        each = choosing // ((rounds - k) * len(left))
        if each:
            repeated = evaluate(points[left].repeat(each, 1)).reshape(each, -1).mT.cpu()
            choosing, evaluations = choosing - repeated.numel(), evaluations - repeated.numel()
            losses = torch.cat([losses, torch.where(torch.isfinite(repeated), repeated, torch.inf)], 1)
            means = losses.mean(1)
            if trusted:
                means[left == 0] -= _bound([*losses], noise, _CONTRADICTION) * math.sqrt(2.0 / losses.shape[1])
            order = means.argsort()
            rival = (int(left[order[1]]), losses[order[1]]) if len(left) > 1 else None
            better = order[: math.ceil(len(left) / 2)]
            left, losses = left[better], losses[better]
    chosen, earlier, first = int(left[0]), losses[0], evaluations // 2 if rival else evaluations
    repeated = evaluate(points[[chosen]].repeat(first, 1)).to(losses)
    if rival:
        doubted = _is_lower(rival[1], torch.cat([earlier, repeated]), noise, _DOUBT)
        last = evaluate(points[[rival[0] if doubted else chosen]].repeat(evaluations - first, 1)).to(losses)
        if not doubted:
            repeated = torch.cat([repeated, last])
        elif _is_lower(torch.cat([rival[1], last]), torch.cat([earlier, repeated]), noise, _DOUBT):
            (chosen, earlier), repeated = rival, last
    repeated, earlier = (one[torch.isfinite(one)] for one in (repeated, earlier))
    if not len(repeated):
        repeated, earlier = earlier, repeated
    if not len(repeated):
        return None
    return chosen, float(repeated.mean()), _spread([repeated, earlier], noise) / math.sqrt(len(repeated))


def _is_lower(values: Tensor, others: Tensor, noise: float, errors: float) -> bool:
    """Whether the mean of values [K] is lower than that of others [L] by a number of standard errors."""
    groups = [one[torch.isfinite(one)] for one in (values, others)]
    apart = float(groups[1].mean() - groups[0].mean())  # NaN without a value
    return apart > _bound(groups, noise, errors) * math.sqrt(sum(1.0 / max(len(one), 1) for one in groups))


def _bound(groups: Sequence[Tensor], noise: float, errors: float) -> float:
    """Return what a number of standard errors is for one value of groups [K], if the deviation may be below `noise`.

    The deviation in the groups counts if it is larger, or if it is smaller by more than the errors of so few values:
    Wallace (1959) gives the number for Student's t. Equal values tell no deviation.
    """
    measured, freedom = _pooled(groups, noise)
    bound = errors * max(noise, measured)
    if measured == 0.0:
        return bound
    exponent = (errors * (8 * freedom + 3) / (8 * freedom + 1)) ** 2 / freedom
    return min(bound, math.sqrt(freedom * math.expm1(exponent)) * measured)


def _pooled(groups: Sequence[Tensor], noise: float) -> tuple[float, int]:
    """Return the standard deviation of the finite values in groups [K] of different means, and its degrees of freedom.

    The deviation is 0 if there are no degrees of freedom. Squares of what is far below the noise may vanish.
    """
    groups = [one[torch.isfinite(one)] for one in groups]
    freedom = sum(len(one) - 1 for one in groups if len(one))
    if freedom == 0:
        return 0.0, 0
    apart = [one - one[0] for one in groups if len(one)]  # exactly 0 where values are equal, as their mean is not
    size = max(noise, *(float(one.abs().max()) for one in apart)) or 1.0  # squares over it do not overflow
    return math.sqrt(sum(float((one - one.mean()).div(size).square().sum()) for one in apart) / freedom) * size, freedom


def _spread(groups: Sequence[Tensor], noise: float) -> float:
    """Return the standard deviation of groups [K] of values with different means, if it was expected to be `noise`.

    Paulson (1942) gives a normal number with the probability of a ratio of two variances that are equal in truth. The
    variance `noise`^2 is taken for a measured one.
    """
    measured, freedom = _pooled(groups, noise)
    if measured == 0.0 or measured >= noise:
        return max(noise, measured)
    ratio, own, other = (measured / noise) ** (2 / 3), 2 / (9 * freedom), 2 / (9 * (REPEATED - 1))
    smaller = (1 - other) * ratio - (1 - own) < -_SIGNIFICANT * math.sqrt(own + other * ratio**2)
    return measured if smaller else noise
