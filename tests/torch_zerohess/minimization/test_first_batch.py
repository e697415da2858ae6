"""The first batch of a search whose noise is measured."""

import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.minimization.first_batch import evaluate_first_batch
from torch_zerohess.minimization.record import Record
from torch_zerohess.search.trust_region import TrustRegion
from truths import squares


def lengths(y: Tensor) -> Tensor:
    return y.square().sum()


@pytest.mark.parametrize(("n", "loss"), [(1, None), (2, None), (5, None), (2, lengths)])
def test_a_method_for_noise_gets_the_points_of_the_other_one(n, loss) -> None:
    """These methods begin with other points than those for functions without noise, and so would evaluate again."""
    generator = torch.Generator().manual_seed(0)
    x0 = torch.full((n,), 0.8, dtype=torch.float32)

    def call(points: Tensor):
        values = points.double() if loss else squares(points.double())
        noise = 0.05 * torch.randn(values.shape, generator=generator, dtype=torch.float64)
        return list(range(len(points))), values + noise, None

    def make(noise: float) -> TrustRegion:
        return TrustRegion(x0, sigma=0.5, loss=loss, noise=noise, seed=0)

    search = make(0.0)
    record = Record(call, search.losses, search.x)
    noise, search, points, losses = evaluate_first_batch(search.ask(7), record, search, make, 8, 100)
    assert noise > 0.02
    assert search.evaluations == len(points) == len(losses) == max(n + 1, 7) + 7
    assert torch.isfinite(torch.tensor(search.value))


@pytest.mark.parametrize("seed", range(3))
def test_a_target_that_the_first_batch_reaches_is_seen(seed) -> None:
    """There are no evaluations for a second batch."""
    generator = torch.Generator().manual_seed(seed)

    def noisy(z: Tensor) -> Tensor:
        return (z - 0.3).square().sum(1) + 0.02 * torch.randn(len(z), generator=generator, dtype=torch.float64)

    fit = zh.minimize(noisy, [0.8, 0.8], sigma=0.5, target=0.4, batch=16, max_evaluations=18, seed=seed)
    assert (fit.status, fit.success) == ("target", True)
    assert fit.value <= 0.4


def test_no_point_is_chosen_that_cannot_be_evaluated(monkeypatch) -> None:
    """A batch of thousands is chosen one point after the other, by a Gaussian process of those before."""
    wanted, ask = [], TrustRegion.ask

    def noted(self, batch: int = 1, *, limit: int | None = None) -> Tensor:
        wanted.append(batch)
        return ask(self, batch, limit=limit)

    monkeypatch.setattr(TrustRegion, "ask", noted)
    settings = {"sigma": 0.5, "bounds": (-1, 1), "seed": 0}
    assert zh.minimize(squares, [0.8, 0.8], batch=100, max_evaluations=12, **settings).evaluations == 12
    assert max(wanted) <= 12
