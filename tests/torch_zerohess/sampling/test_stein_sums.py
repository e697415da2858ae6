"""Coefficients, gradient and Hessian times vector in one operator each, against their references in torch."""

import math

import pytest
import torch
from torch import Tensor

from torch_zerohess.sampling import extension, kernels, proposals, stein_sums
from truths import doubles, spread

ops = torch.ops.torch_zerohess
EPS = torch.finfo(torch.float64).eps
SIZES = [(1, 1, 1, 2), (1, 1, 16, 2), (2, 3, 11, 300), (3, 8, 600, 9), (2, 9, 11, 3)]  # B, M, K, n


def made(B: int, M: int, K: int, n: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    u = proposals.draw(proposals.pick_rows(1, 0, B * K, n, proposals.SECOND_ORDER), n).view(B, K, n)
    weight, a = spread(B * K, 0.1, 3.0).view(B, K), spread(B * M * K, -1.0, 1.0).view(B, M, K)
    return u, weight, a, spread(B * M * n, -2.0, 1.0).view(B, M, n)


def share(B: int, K: int, dropped: int) -> Tensor:
    kept = (torch.arange(B * K).view(B, K, 1) % K >= dropped).double()
    return kept / kept.sum(1, keepdim=True)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
@pytest.mark.parametrize("offset", [0.0, 1e12])
@pytest.mark.parametrize("center", [True, False])
def test_coefficients_have_the_bits_of_the_reference(
    center: bool, offset: float, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch
) -> None:
    for B, K, P in ((1, 1, 1), (1, 16, 1), (2, 7, 5), (3, 200, 300)):
        values = (spread(B * (K + 1) * P, -1.0, 3.0).view(B, K + 1, P) + offset).to(dtype)
        for weights in (None, share(B, K, 0), share(B, K, min(2, K - 1))):
            got = stein_sums.coefficients(values, weights, K, center)
            with monkeypatch.context() as without:
                without.setattr(extension, "available", False)
                expected = stein_sums.coefficients(values, weights, K, center)
            assert got.dtype == torch.float64
            assert got.shape == (B, K, P)
            assert torch.equal(got.nan_to_num(7.0), expected.nan_to_num(7.0))
            f = values.double()  # by hand, in the formula of the documentation
            baseline = f[:, K:] if center else torch.zeros_like(f[:, K:])
            by_hand = (f[:, :K] - baseline) * (share(B, K, 0) if weights is None else weights)
            torch.testing.assert_close(got, by_hand, rtol=1e-14, atol=0.0, equal_nan=True)


@pytest.mark.parametrize("available", [True, False])
@pytest.mark.parametrize("out", [(), (1,), (2, 3), (0,)])
def test_coefficients_take_outputs_of_any_shape(
    out: tuple[int, ...], available: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extension, "available", available)
    flat = spread(2 * 5 * 6, -1.0, 3.0).view(2, 5, 6)[:, :, : math.prod(out)]
    got = stein_sums.coefficients(flat.reshape(2, 5, *out), None, 4, True)
    assert torch.equal(got, stein_sums.coefficients(flat, None, 4, True))


@pytest.mark.parametrize("size", SIZES)
def test_gradient_is_the_sum_of_weighted_rows(size: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    u, weight, a, _ = made(*size)
    got = stein_sums.gradient(u, weight, a)
    assert torch.equal(got, kernels.accumulate(u, a * weight[:, None]))
    monkeypatch.setattr(extension, "available", False)
    bound = (size[2] + 4) * EPS * ((a * weight[:, None]).abs() @ u.abs())
    assert bool(((stein_sums.gradient(u, weight, a) - got).abs() <= bound).all())


@pytest.mark.parametrize("size", SIZES)
def test_hvp_is_the_hessian_times_the_vector(size: tuple[int, int, int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    (_, _, K, n), (u, weight, a, v) = size, made(*size)
    got = stein_sums.hvp(u, weight, a, v)
    w = a * weight[:, None]
    hessian = u.mT[:, None] @ (w[..., None] * u[:, None]) - w.sum(2)[..., None, None] * torch.eye(n).double()
    magnitudes = u.mT[:, None].abs() @ (w[..., None] * u[:, None]).abs() + w.abs().sum(2)[..., None, None]
    bound = (K + n + 4) * EPS * (magnitudes @ v.abs()[..., None])[..., 0]
    assert bool(((got - (hessian @ v[..., None])[..., 0]).abs() <= bound).all())
    monkeypatch.setattr(extension, "available", False)
    assert bool(((stein_sums.hvp(u, weight, a, v) - got).abs() <= bound).all())


@pytest.mark.parametrize("available", [True, False])
@pytest.mark.parametrize("size", SIZES)
def test_sums_in_units_of_x_are_divided_by_sigma(
    size: tuple[int, int, int, int], available: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extension, "available", available)
    u, weight, a, v = made(*size)
    sigma = spread(size[3], 0.1, 3.0)
    gradient, hvp = stein_sums.gradient(u, weight, a), stein_sums.hvp(u, weight, a, v / sigma)
    assert torch.equal(stein_sums.gradient(u, weight, a, sigma), gradient / sigma)
    assert torch.equal(stein_sums.hvp(u, weight, a, v, sigma), hvp / sigma)
    assert torch.equal(v, made(*size)[3])


def test_perturbations_that_are_drawn_again_have_the_same_sums() -> None:
    B, S, n = 2, 6, 5
    rows = kernels.pick_rows(3, 0, B * S, n, proposals.SECOND_ORDER, torch.device("cpu"))
    x, sigma = spread(B * n, -3.0, 3.0).view(B, n), spread(n, 0.1, 1.0)
    redrawn = kernels.Redrawn(rows, x, sigma, True, False)
    u = kernels.place(kernels.draw(rows, n), x, sigma, True, False, proposals.GAUSSIAN)[1]
    _, weight, a, v = made(B, 2, 2 * S, n)
    assert torch.equal(stein_sums.gradient(redrawn, weight, a), stein_sums.gradient(u, weight, a))
    got, expected = stein_sums.hvp(redrawn, weight, a, v), stein_sums.hvp(u, weight, a, v)
    torch.testing.assert_close(got, expected, rtol=0.0, atol=100 * EPS * float(expected.abs().max()))


def test_inputs_in_any_layout() -> None:
    u, weight, a, v = made(2, 3, 6, 5)
    turned = [one.mT.contiguous().mT for one in (u, weight, a, v)]
    assert not any(one.is_contiguous() for one in turned)
    assert torch.equal(stein_sums.gradient(*turned[:3]), stein_sums.gradient(u, weight, a))
    assert torch.equal(stein_sums.hvp(*turned), stein_sums.hvp(u, weight, a, v))
    values = spread(2 * 7 * 3, -1.0, 1.0).view(2, 7, 3)
    wide = stein_sums.coefficients(values.mT.contiguous().mT, None, 6, True)
    assert torch.equal(wide, stein_sums.coefficients(values, None, 6, True))


OPCHECKED = {
    "coefficients": lambda u, weight, a, v: (a.mT.contiguous(), None, 5, True),
    "coefficients with shares": lambda u, weight, a, v: (a.mT.contiguous().float(), share(2, 6, 2), 6, False),
    "coefficients of images": lambda u, weight, a, v: (a.view(2, 3, 2, 3, 1), None, 3, False),
    "weighted_gradient": lambda u, weight, a, v: (u, weight, a),
    "weighted_gradient in units of x": lambda u, weight, a, v: (u, weight, a, weight[0, :5].contiguous()),
    "weighted_hvp": lambda u, weight, a, v: (u, weight, a, v),
    "weighted_hvp in units of x": lambda u, weight, a, v: (u, weight, a, v, weight[0, :5].contiguous()),
}


@pytest.mark.parametrize("name", OPCHECKED)
def test_operators_pass_the_checks_of_torch(name: str) -> None:
    operator = getattr(ops, name.split()[0]).default
    torch.library.opcheck(operator, OPCHECKED[name](*made(2, 3, 6, 5)))


def test_any_number_of_threads_gives_the_same_bits() -> None:
    u, weight, a, v = made(2, 3, 150, 300)
    values, sigma = spread(2 * 200 * 300, -1.0, 1.0).view(2, 200, 300), spread(300, 0.1, 1.0)

    def everything() -> list[Tensor]:
        c = stein_sums.coefficients(values, None, 199, True)
        scaled = [stein_sums.gradient(u, weight, a, sigma), stein_sums.hvp(u, weight, a, v, sigma)]
        return [c, stein_sums.gradient(u, weight, a), stein_sums.hvp(u, weight, a, v), *scaled]

    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        one = everything()
        for threads in (2, 5):
            torch.set_num_threads(threads)
            assert all(torch.equal(p, q) for p, q in zip(one, everything(), strict=True)), threads
    finally:
        torch.set_num_threads(before)


WRONG = {
    "coefficients: dimensions": lambda: ops.coefficients(doubles(3), None, 2, True),
    "coefficients: type": lambda: ops.coefficients(doubles(2, 3, 1).half(), None, 2, True),
    "coefficients: no center": lambda: ops.coefficients(doubles(2, 3, 1), None, 3, True),
    "coefficients: no rows": lambda: ops.coefficients(doubles(2, 3, 1), None, 0, False),
    "coefficients: share": lambda: ops.coefficients(doubles(2, 3, 1), doubles(2, 3, 1), 2, True),
    "coefficients: dimensions of share": lambda: ops.coefficients(doubles(2, 3, 1), doubles(2, 2), 2, True),
    "gradient: K": lambda: ops.weighted_gradient(doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 5)),
    "gradient: weight": lambda: ops.weighted_gradient(doubles(2, 4, 3), doubles(2, 3), doubles(2, 1, 4)),
    "gradient: batch": lambda: ops.weighted_gradient(doubles(1, 4, 3), doubles(2, 4), doubles(2, 1, 4)),
    "gradient: type": lambda: ops.weighted_gradient(doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4).float()),
    "gradient: sigma": lambda: ops.weighted_gradient(doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4), doubles(2)),
    "gradient: dimensions of sigma": lambda: ops.weighted_gradient(
        doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4), doubles(3, 1)
    ),
    "hvp: sigma": lambda: ops.weighted_hvp(
        doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4), doubles(2, 1, 3), doubles(4)
    ),
    "hvp: type of sigma": lambda: ops.weighted_hvp(
        doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4), doubles(2, 1, 3), doubles(3).float()
    ),
    "hvp: n": lambda: ops.weighted_hvp(doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4), doubles(2, 1, 4)),
    "hvp: M": lambda: ops.weighted_hvp(doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4), doubles(2, 2, 3)),
    "hvp: dimensions": lambda: ops.weighted_hvp(doubles(2, 4, 3), doubles(2, 4), doubles(2, 1, 4), doubles(2, 3)),
}


@pytest.mark.parametrize("call", WRONG.values(), ids=WRONG.keys())
def test_wrong_shapes_raise(call, capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(RuntimeError):
        call()
    assert capfd.readouterr().err == "", "LibTorch was asked about an argument that was not checked"
