"""The local entropy F = -T log E exp(-l / T) of losses l, as an outer function of one smoothed quantity.

Z(x) = E exp((m - l) / T) is smoothed like any other output, and F = m - T log Z. T and m are constants of each batch
element. They travel with the samples as further elements of the output: (exp((m - l) / T), T, m, l(x)).
"""

import torch
from torch import Tensor

ELEMENTS = 4
"""Of a packed output."""


def scales(losses: Tensor, mean: Tensor, temperature: float) -> tuple[Tensor, Tensor]:
    """Return T = `temperature` times the mean loss [B], and m, the least of losses [B, K]: float64 [B] each."""
    T = temperature * mean.detach().double().abs()
    return T.clamp_min(torch.finfo(torch.float32).tiny), losses.detach().double().min(1).values


def tempered(losses: Tensor, T: Tensor, m: Tensor) -> Tensor:
    """Return exp((m - l) / T) for losses [B, K]; at most e^60, for the smallest losses that m did not know."""
    return ((m[:, None] - losses) / T[:, None]).clamp(max=60.0).exp()


def packed(losses: Tensor, center: Tensor | None, T: Tensor, m: Tensor) -> tuple[Tensor, Tensor | None]:
    """Return the packed outputs [B, K, 4] of losses [B, K], and those of the losses at the center [B], [B, 4]."""
    last = torch.zeros_like(T) if center is None else center.double()
    constants = torch.stack([T, m, last], 1)
    rows = torch.cat([tempered(losses.double(), T, m)[..., None], constants[:, None].expand(-1, losses.shape[1], 3)], 2)
    if center is None:
        return rows, None
    return rows, torch.cat([tempered(center.double()[:, None], T, m), constants], 1)
