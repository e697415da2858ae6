"""Functions that fail at some points, or are rough: the result is the lowest loss that was evaluated, and says so."""

import math
import sys

import pytest
import torch
from searches import sum_of_squares
from torch import Tensor

import torch_zerohess as zh

TIMES = torch.arange(20, dtype=torch.float64) / 10.0


def curve(x: Tensor) -> Tensor:
    return x[0] * torch.exp(-x[1] * TIMES)


DATA = curve(torch.tensor([1.7, 0.9], dtype=torch.float64))


squares = sum_of_squares(DATA)


def failing(x: Tensor) -> Tensor:
    """At a fifth of all points, always the same ones."""
    return torch.full_like(TIMES, math.nan) if int(abs(float(x[0]) * 1e6)) % 10 in (3, 5) else curve(x)


def rough(x: Tensor) -> Tensor:
    """The same at each call, and as different from point to point as noise."""
    mixed = [round(abs(float(one)) * 1e9) for one in x]
    generator = torch.Generator().manual_seed((mixed[0] * 7919 + mixed[1]) % 2**31)
    return curve(x) + 0.3 * torch.randn(len(TIMES), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("seed", range(2))
def test_failures_are_no_noise(seed: int) -> None:
    settings = {"sigma": 0.8, "bounds": (0.01, 4.0), "loss": squares, "seed": seed}
    fit = zh.minimize(failing, [1.0, 0.2], vectorized=False, max_evaluations=60, **settings)
    assert fit.engine == "gaussian_process"
    assert fit.value == float(squares(failing(fit.x))) == float(fit.values.nan_to_num(math.inf).min()) < 1e-12
    count = int(fit.values.isnan().sum())
    assert f"; values or outputs that are not finite, and were left out: {count}" in fit.message
    search = zh.optim.TrustRegion([1.0, 0.2], **settings)
    while search.evaluations < 60 and not search.done:
        search.tell(torch.stack([failing(one) for one in search.ask()]))
    assert search.value == float(squares(failing(search.x))) < 1e-12


@pytest.mark.parametrize("seed", range(2, 5))
@pytest.mark.parametrize("noise", [None, 0.0])
def test_a_rough_function_has_the_lowest_loss_that_was_evaluated(seed: int, noise: float | None) -> None:
    settings = {"sigma": 1.0, "bounds": (0.0, 3.0), "loss": squares, "vectorized": False, "seed": seed, "noise": noise}
    fit = zh.minimize(rough, [0.2, 2.0], max_evaluations=100, **settings)
    assert fit.value == float(squares(rough(fit.x))) == float(fit.values.min())
    assert not fit.success, "a random low value is no minimum"
    again = zh.minimize(rough, [0.2, 2.0], max_evaluations=100, target=fit.value, **settings)
    assert again.status == "target"
    assert float(again.values[-1]) == again.value == fit.value


@pytest.mark.parametrize("restarts", [None, 0])
def test_outputs_that_are_not_finite_have_no_loss(restarts: int | None) -> None:
    """The loss ignores a number that is missing; the search, which models it, cannot."""
    data = torch.tensor([0.3, -0.5, 0.1, 1.3], dtype=torch.float64)

    def output(x: Tensor) -> Tensor:
        y = torch.stack([x[0], x[1], x[0] ** 2, x[1] ** 2 - x[0] + 1.35])
        return torch.where((x[0] < 0.5) & (torch.arange(4) == 2), math.nan, y)

    fit = zh.minimize(
        output,
        torch.tensor([1.0, 2.0], dtype=torch.float64),
        sigma=1.0,
        loss=lambda y: (y - data).nan_to_num(0.0).square().sum(),
        vectorized=False,
        seed=0,
        max_evaluations=100,
        restarts=restarts,
    )
    assert torch.equal(fit.values.isnan(), fit.points[:, 0] < 0.5)
    assert fit.value == float(fit.values.nan_to_num(math.inf).min())
    assert f"; values or outputs that are not finite, and were left out: {int(fit.values.isnan().sum())}" in fit.message


def breaks(z: Tensor) -> Tensor:
    """At the second point of a batch, or at each point of its own but x0."""
    if float(z.flatten()[-1]) != 0.0:
        raise ValueError("lost the scene")
    return z.square().sum(-1)


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
@pytest.mark.parametrize("workers", [None, 1])
def test_an_error_says_at_which_point_fn_was(workers) -> None:
    settings = {"sigma": 1.0, "seed": 0, "noise": 0.0, "engine": "descent"}
    with pytest.raises(ValueError, match="lost the scene") as raised:
        zh.minimize(breaks, [0.0], vectorized=False, workers=workers, **settings)
    note = raised.value.__notes__[-1]
    assert note.startswith("fn was called at the point [")
    with pytest.raises(ValueError, match="lost the scene") as raised:
        zh.minimize(breaks, [0.0], **settings)
    assert raised.value.__notes__[-1].startswith("fn was called at the points [0], [")


@pytest.mark.skipif(sys.version_info < (3, 11), reason="exceptions have no notes")
def test_an_error_names_the_first_point_without_a_value() -> None:
    """The first batch has three points, and the second one fails."""
    calls: list[Tensor] = []

    def fn(x: Tensor) -> float:
        calls.append(x.clone())
        if len(calls) == 2:
            raise ValueError("lost the scene")
        return float(x.square().sum())

    with pytest.raises(ValueError, match="lost the scene") as raised:
        zh.minimize(fn, [0.0, 0.0], sigma=1.0, seed=0, noise=0.0, vectorized=False)
    x, y = calls[-1].tolist()
    assert raised.value.__notes__ == [
        f"fn was called at the point [{x:.6g}, {y:.6g}]. Where nothing can be computed, let it return NaN: the search "
        "avoids such points"
    ]
