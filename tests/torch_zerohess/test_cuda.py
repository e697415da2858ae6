"""Tensors on a CUDA device give the numbers of the processor. Without a device the processor stands for it."""

import contextlib
import itertools

import pytest
import torch
from searches import bars, square

import torch_zerohess as zh
from torch_zerohess.sampling import kernels, proposals
from truths import spread, vector

DEVICE = torch.device("cuda" if torch.cuda.is_available() else "cpu")
X = vector(0.3, -0.5, 0.7)


def smooth(z):
    return z.sin().sum(-1) + z.prod(-1) + z[..., 0].exp()


def blurred(x):
    return torch.nn.functional.avg_pool2d(x.view(-1, 30, 30), 3, 1)


def same(made, expected, rtol: float = 1e-11) -> None:
    for got, known in zip(made, expected, strict=True):
        assert got.device.type == DEVICE.type
        torch.testing.assert_close(got.cpu(), known, rtol=rtol, atol=rtol * (1.0 + float(known.abs().max())))


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("n", [1, 5, 4097])
def test_rows_of_every_kind_have_the_same_bits(n: int, single: bool) -> None:
    index = torch.arange(600 if n < 100 else 150)
    rows = torch.stack([index * 2**40, index - 300, index % 6], 1)
    places = torch.randint(0, n, (len(index), 2), generator=torch.Generator().manual_seed(0))
    rows = torch.cat([rows, places], 1)
    assert torch.equal(kernels.draw(rows.to(DEVICE), n, single).cpu(), proposals.draw(rows, n, single))


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("proposal", [proposals.GAUSSIAN, proposals.SIGNED_LOBES])
def test_a_million_numbers_have_the_same_bits(proposal: int, single: bool) -> None:
    """Constants of comparisons that are rounded to float32 change one bit in about ten million numbers."""
    rows = proposals.pick_rows(7, 9, 1, 1 << 20, proposal)  # this row has a number next to the constant 0.425
    assert torch.equal(kernels.draw(rows.to(DEVICE), 1 << 20, single).cpu(), proposals.draw(rows, 1 << 20, single))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("proposal", range(5))
def test_samples_have_the_same_bits(proposal: int, dtype: torch.dtype) -> None:
    for (S, n), both, center, keep in itertools.product([(3, 7), (2, 1040)], *3 * [(False, True)]):
        x, sigma = spread(2 * n, -1.0, 1.0).view(2, n).to(dtype), spread(n, 0.1, 1.0)
        settings = both, proposal, center, keep
        rows, *made = kernels.sample(11, S, x.to(DEVICE), sigma.to(DEVICE), *settings)
        u = proposals.draw(rows.cpu(), n, dtype == torch.float32)
        points, signed, weights = proposals.place(u, x.double(), sigma, both, dtype == torch.float32, proposal)
        points = torch.cat([points, x[:, None]], 1) if center else points
        assert torch.equal(made[0].cpu(), points)
        assert torch.equal(made[1].cpu(), signed[: 2 if keep else 0])
        bound = 2.0**-52 * (12 * n + 8 if proposal == proposals.UNIFORM else 2 * n + 9)
        if DEVICE.type == "cuda":  # on the processor sums in float32 are shorter
            assert bool(((made[2].cpu() - weights).abs() <= bound * weights).all())


@pytest.mark.parametrize("antithetic", [False, True])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(("B", "S", "n", "M"), [(2, 300, 3, 1), (1, 7, 5000, 3), (2, 3, 40, 6)])
def test_sums_of_rows_drawn_again_are_the_same(B: int, S: int, n: int, M: int, dtype: torch.dtype, antithetic: bool):
    for proposal in range(5):
        recipe = (proposals.pick_rows(3, 0, B * S, n, proposal), spread(B * n, -1.0, 1.0).view(B, n).to(dtype))
        settings = spread(n, 0.1, 1.0), antithetic, dtype == torch.float32
        here = kernels.Redrawn(*recipe, *settings)
        there = kernels.Redrawn(*(one.to(DEVICE) for one in here[:3]), *settings[1:])
        t, a = spread(B * M * n, -1.0, 2.0).view(B, M, n), spread(B * M * here.K, -2.0, 1.0).view(B, M, here.K)
        for function, vectors in ((kernels.project, t), (kernels.accumulate, a), (kernels.accumulate_squares, a)):
            got = function(there, vectors.to(DEVICE))
            same([got], [function(here, vectors)])
            assert torch.equal(function(there, vectors.to(DEVICE)), got)


def settings_that_there_are():
    for proposal, sampler, baseline, antithetic in itertools.product(
        ("gaussian", "aggregate", "optimal", "uniform"),
        ("random", "orthogonal", "sobol"),
        ("none", "mean", "center"),
        (False, True),
    ):
        with contextlib.suppress(ValueError):
            given = {"proposal": proposal, "sampler": sampler, "baseline": baseline, "antithetic": antithetic}
            smoothing = zh.Smoothing(sigma=0.2, samples=16, seed=3, **given)
            zh.estimate(smooth, X, smoothing)
            yield smoothing


@pytest.mark.parametrize("smoothing", list(settings_that_there_are()), ids=repr)
def test_estimates_are_the_same(smoothing: zh.Smoothing) -> None:
    there, here = zh.estimate(smooth, X.to(DEVICE), smoothing), zh.estimate(smooth, X, smoothing)
    one, other = ((e.value, e.gradient, e.hessian(), e.hvp(X.to(e.value.device))) for e in (there, here))
    same(one, other)


def test_every_transform_of_a_layer_gives_the_same() -> None:
    def derivatives(device):
        layer = zh.BlackBox(smooth, zh.Smoothing(sigma=0.2, samples=64, seed=1))
        x = torch.stack([X, X * X]).to(device).requires_grad_()
        (gradient,) = torch.autograd.grad(layer(x).sum(), x, create_graph=True)
        (product,) = torch.autograd.grad((gradient * x.detach()).sum(), x)
        mapped = torch.func.vmap(torch.func.grad(layer), randomness="different")(x.detach())
        return layer(x).detach(), gradient.detach(), product, torch.func.hessian(layer)(x[0].detach()), mapped

    same(derivatives(DEVICE), derivatives("cpu"))


def test_a_thousand_parameters_that_act_locally() -> None:
    def found(device):
        J = zh.sparse_jacobian(
            blurred, torch.zeros(900, device=device), zh.Smoothing(sigma=0.3, samples=60, seed=0), grid=(30, 30)
        )
        return (J.dense(),)

    same(found(DEVICE), found("cpu"), rtol=1e-4)


@pytest.mark.parametrize("engine", ["auto", "descent", "gaussian_process"])
def test_a_search_ends_on_the_device_of_its_start(engine: str) -> None:
    picture = bars(torch.linspace(0, 1, 64, device=DEVICE))
    wanted = picture(torch.tensor([[0.3, 0.5]], device=DEVICE))[0]
    start = torch.tensor([0.8, 0.2], dtype=torch.float64, device=DEVICE)
    fit = zh.minimize(
        picture,
        start,
        sigma=0.3,
        bounds=(0, 1),
        loss=square(wanted),
        engine=engine,
        max_evaluations=150,
        target=0.0,
        seed=0,
    )
    assert fit.value == 0.0
    assert {one.device.type for one in (fit.x, fit.gradient, fit.hessian)} == {DEVICE.type}


@pytest.mark.parametrize(
    "fn", [lambda z: z.cpu().numpy().sum(-1), lambda z: z.sum(-1).cpu(), lambda z: z.sum(-1).tolist()]
)
def test_a_black_box_may_answer_from_the_processor(fn) -> None:
    estimate = zh.estimate(fn, X.to(DEVICE), zh.Smoothing(sigma=0.2, samples=8, seed=0))
    assert estimate.gradient.device.type == DEVICE.type
    same([estimate.value], [X.sum()])
