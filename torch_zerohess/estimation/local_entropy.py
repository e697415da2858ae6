"""The local entropy F = -T log E exp(-l / T) of losses l, as an outer function of one smoothed quantity.

Z(x) = E exp((m - l) / T) is smoothed like any other output, and F = m - T log Z. T and m are constants of each batch
element. They travel with the samples as further elements of the output: (exp((m - l) / T), T, m, l(x)).
"""

import torch
from torch import Tensor


def scales(losses: Tensor, mean: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    """Return T = `temperature` times the mean loss [B], and m, the least of losses [B, K]: float64 [B] each."""
    T = temperature * mean.detach().double().abs()
    return T.clamp_min(torch.finfo(torch.float32).tiny), losses.detach().double().min(1).values


def tempered(losses: Tensor, T: Tensor, m: Tensor) -> Tensor:
    """Return exp((m - l) / T) for losses [B, K]; at most e^60, for the smallest losses that m did not know."""
    return ((m[:, None] - losses) / T[:, None]).clamp(max=60.0).exp()


def packed(losses: Tensor, K: int, T: Tensor, m: Tensor) -> Tensor:
    """Return the packed outputs [B, E, 4] of losses [B, E], of which the one after the first K is at the center."""
    center = losses[:, K].double() if losses.shape[1] > K else torch.zeros_like(T)
    constants = torch.stack([T, m, center], 1)[:, None].expand(-1, losses.shape[1], 3)
    return torch.cat([tempered(losses.double(), T, m)[..., None], constants], 2)
