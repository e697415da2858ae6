"""What tests compare with: closed forms in n dimensions, deviations in standard errors, and numbers to start from."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from experiments.problems.closed_forms import Bump, ClosedForm, Exponential, PlaneWave, Quadratic, Step

__all__ = [
    *("Bump", "ClosedForm", "Exponential", "Image", "PlaneWave", "Quadratic", "Step"),
    *("deviation", "doubles", "magnitudes", "normal", "spread", "squares", "truths", "vector"),
]


@dataclass(frozen=True)
class Image(ClosedForm):
    """Several closed forms as one tensor-valued function, [2, m / 2]."""

    parts: tuple[ClosedForm, ...]

    def __call__(self, z: Tensor) -> Tensor:
        return torch.stack([part(z) for part in self.parts], 1).unflatten(1, (2, -1))

    def smoothed(self, x: Tensor, sigma: Tensor) -> Tensor:
        return torch.stack([part.smoothed(x, sigma) for part in self.parts]).unflatten(0, (2, -1))


def vector(*numbers: float) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)


def normal(*shape: int, seed: int = 0) -> Tensor:
    """Return standard normal numbers of this shape, in float64."""
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def doubles(*shape: int) -> Tensor:
    return torch.zeros(shape, dtype=torch.float64)


def squares(z: Tensor) -> Tensor:
    """Return the sum of squares of every row."""
    return z.square().sum(1)


def magnitudes(y: Tensor) -> Tensor:
    """Return the sum of all magnitudes."""
    return y.abs().sum()


def spread(n: int, low: float, high: float) -> Tensor:
    """Return n different numbers between low and high, in no monotonic order."""
    return low + (high - low) * torch.remainder(0.6180339887498949 * torch.arange(1, n + 1, dtype=torch.float64), 1.0)


def truths(n: int) -> dict[str, ClosedForm]:
    """Return one closed form of each kind in n dimensions, varying by about one over a distance of one."""
    k = spread(n, -1.2, 1.2) / math.sqrt(n)
    skew = torch.outer(spread(n, -1.0, 1.0), spread(n, 0.2, 1.0)) / n
    quadratic = Quadratic(skew + skew.T + torch.diag(spread(n, -1.0, 1.0)), k, 0.5)
    wave, exponential, bump, step = PlaneWave(k + 0.3), Exponential(k), Bump(1.3), Step(k, 0.1)
    return {
        "quadratic": quadratic,
        "wave": wave,
        "exponential": exponential,
        "bump": bump,
        "step": step,
        "image": Image((wave, exponential, bump, quadratic)),
    }


def deviation(samples: Tensor, truth: Tensor, rounding: float = 0.0) -> float:
    """Return the largest |mean - truth| over the replicates samples [R, ...], in standard errors of that mean.

    `rounding` is a relative error of the truth's largest element that is granted besides.
    """
    mean = samples.double().mean(0)
    error = samples.double().std(0) / math.sqrt(len(samples))
    granted = (rounding + 1e-13) * float(truth.abs().max())
    excess = ((mean - truth).abs() - granted).clamp_min(0.0)
    # Where every replicate is the same number (a noise-free case), only the rounding is granted.
    return float(torch.where(error > 0, excess / error, torch.where(excess > 0, torch.inf, 0.0)).max())
