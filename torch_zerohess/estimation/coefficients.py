"""From values to the coefficients of the Stein sums: what is subtracted, and the weight of each row."""

import torch
from torch import Tensor

from torch_zerohess.estimation.perturbations import draws
from torch_zerohess.sampling import stein_sums
from torch_zerohess.sampling.stein_sums import total
from torch_zerohess.smoothing import Smoothing


def share_of(kept: Tensor | None, B: int, K: int, device: torch.device) -> Tensor:
    """Return the weight of each row in a mean, [B, K, 1]: 1/K, and for rows that are not in `kept` [B, K] zero."""
    if kept is None:
        return torch.full((B, K, 1), 1.0 / K, dtype=torch.float64, device=device)
    return (kept / kept.sum(1, keepdim=True).double())[..., None]


def coefficients_of(
    values: Tensor, share: Tensor | None, K: int, smoothing: Smoothing, n: int
) -> tuple[Tensor | None, Tensor]:
    """Return the mean baseline [B, 1, P] and (f - baseline) * share [B, K, P], for values [B, E, *out].

    The value at the center is the last one, if there is one. share: [B, K, 1]; None: 1/K. The baseline is None where it
    is the value at the center, or zero.
    """
    if smoothing.baseline != "mean":
        return None, stein_sums.coefficients(values, share, K, smoothing.baseline == "center")
    f = values[:, :K].double().reshape(len(values), K, -1)
    share = share_of(None, len(f), K, f.device) if share is None else share
    baseline = mean_of_others(f, share, draws(smoothing, n))
    return total(baseline * share), (f - baseline) * share


def baseline_of(values: Tensor, mean: Tensor | None, smoothing: Smoothing) -> Tensor:
    """Return the mean baseline [B, 1, P] of values [B, E, *out], where `mean` is the first of `coefficients_of`."""
    if mean is not None:
        return mean
    center = values[:, -1:].reshape(len(values), 1, -1).double()
    return center if smoothing.baseline == "center" else torch.zeros_like(center)


def without_useless_center(values: Tensor, share: Tensor) -> Tensor:
    """Return values [B, K + 1] with 0 in place of the one at the center, the last one, where it is no baseline.

    A baseline removes variance only if its distance to the mean of the values is at most the size of that mean. Of a
    local entropy the value at the center may be thousands of times the others.

    share: weight of each of the K rows in the mean, [B, K].
    """
    sampled, center = values[:, :-1], values[:, -1:]
    mean = (sampled * share).sum(1, keepdim=True)
    return torch.cat([sampled, torch.where((center - mean).abs() <= mean.abs(), center, 0.0)], 1)


def mean_of_others(f: Tensor, share: Tensor, draws: list[Tensor]) -> Tensor:
    """Mean over the rows of all other independent draws: a baseline that no row's own value enters.

    f: [B, K, P]; share: [B, K, 1], zero for dropped rows; draws: rows [D, r] of the draws, by size.
    """
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
