"""Families of weights: each against its own generating function, across the operator, and one that a test adds.

The sums of a family are the derivatives of sum_k a_k ratio_k(d) at d = 0, which `torch.func` takes without them.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

import torch_zerohess as zh
from torch_zerohess.estimation.perturbations import FAMILIES, draws, perturb, stored
from torch_zerohess.estimation.stein import (
    FIRST_ORDER_ERROR,
    Layout,
    Projection,
    Quantity,
    Spread,
    Stein,
    completed,
)
from torch_zerohess.sampling import kernels, proposals
from torch_zerohess.sampling.stein_sums import total
from truths import Exponential, deviation, spread, vector

N, B, P = 3, 2, 2
S = zh.Smoothing(sigma=spread(N, 0.2, 0.7), samples=5, seed=4)
X = spread(B * N, -1.0, 1.0).view(B, N)
CASES = [
    pytest.param(S.replace(proposal=proposal, antithetic=antithetic), keep, id=f"{proposal}-{antithetic}-{keep}")
    for proposal, antithetic, keep in itertools.product(FAMILIES, (True, False), (True, False))
] + [
    pytest.param(S.replace(order=1), True, id="aggregate, first order"),
    pytest.param(S.replace(proposal="optimal", order=1), True, id="optimal, first order"),
    pytest.param(S.replace(sampler="sobol", proposal="fr22"), False, id="fr22, sobol"),
    pytest.param(S.replace(sampler="sobol"), False, id="sobol cannot be drawn again"),
    pytest.param(S.replace(sampler="orthogonal"), False, id="orthogonal cannot be drawn again"),
]


def plain(u: kernels.Samples, t: Tensor) -> Tensor:
    """The projection in plain torch, which autograd differentiates."""
    if isinstance(u, kernels.Redrawn):
        u = kernels.project(u, torch.eye(N, dtype=torch.float64).expand(B, N, N)).mT
    return t @ u.mT


def close(got: Tensor, expected: Tensor) -> None:
    torch.testing.assert_close(got, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(("smoothing", "keep"), CASES)
def test_sums_are_the_derivatives_of_the_generating_function(smoothing: zh.Smoothing, keep: bool) -> None:
    stein = perturb(X, smoothing, 4, keep).stein
    K = smoothing.evaluations(N, center=False)
    a = spread(B * P * K, -1.0, 1.0).view(B, P, K)

    def generated(d: Tensor) -> Tensor:
        return (a @ stein.ratio(d, plain)[..., None])[..., 0]

    zero = torch.zeros(B, N, dtype=torch.float64)
    each = torch.arange(B)
    close(stein.value(a), generated(zero))
    close(stein.gradient(a), torch.func.jacrev(generated)(zero)[each, :, each])
    if stein.first_order:
        for ask in (stein.hessian, stein.hessian_diagonal, lambda a: stein.hvp(a, a[..., :N])):
            with pytest.raises(ValueError, match="first derivatives only"):
                ask(a)
        return
    hessian = torch.func.jacfwd(torch.func.jacrev(generated))(zero)[each, :, each, :, each]
    v = spread(B * P * N, -1.0, 1.0).view(B, P, N)
    close(stein.hessian(a), hessian)
    close(stein.hessian_diagonal(a), hessian.diagonal(dim1=2, dim2=3))
    close(stein.hvp(a, v), (hessian @ v[..., None])[..., 0])


@pytest.mark.parametrize(("smoothing", "keep"), CASES)
def test_tensors_are_as_laid_out_and_make_the_same_family(smoothing: zh.Smoothing, keep: bool) -> None:
    perturbed = perturb(X, smoothing, 4, keep)
    stein, K = perturbed.stein, smoothing.evaluations(N, center=False)
    tensors, layout = stein.tensors(), stein.layout(smoothing, B, K, N, keep)
    assert [(tuple(one.shape), one.dtype) for one in tensors] == [(one.shape, one.dtype) for one in layout]
    assert all(one.is_contiguous() for one in tensors)
    again = type(stein).rebuild(tensors, X, perturbed.sigma, smoothing, keep)
    a = spread(B * P * K, -1.0, 1.0).view(B, P, K)
    assert again.first_order == stein.first_order
    for quantity in ("value", "gradient") if stein.first_order else ("value", "gradient", "hessian_diagonal"):
        assert torch.equal(again.sums(quantity, a, None), stein.sums(quantity, a, None))
    # A tensor that is not batched is the same for every point.
    alone = perturb(X[1:], smoothing, 4, keep).stein.tensors()
    for one, other, described in zip(alone, tensors, layout, strict=True):
        assert one.shape == (other[1:].shape if described.batched else other.shape)
        assert described.batched or torch.equal(one[:, 2:], other[:, 2:])


@pytest.mark.parametrize(("smoothing", "keep"), CASES)
def test_points_do_not_depend_on_what_is_stored(smoothing: zh.Smoothing, keep: bool) -> None:
    assert torch.equal(perturb(X, smoothing, 4, keep).points, perturb(X, smoothing, 4, True).points)


def test_the_first_order_draws_no_lobes_of_the_second() -> None:
    smoothing = S.replace(samples=200, order=1, antithetic=False)
    kinds = perturb(X, smoothing, 4, False).stein.u.rows[:, 2]
    assert set(kinds.tolist()) == {proposals.NORMAL, proposals.GRADIENT_LOBE}
    both = perturb(X, smoothing.replace(order=2), 4, False).stein.u.rows[:, 2]
    assert {proposals.DIAGONAL_LOBE, proposals.OFF_DIAGONAL_LOBE} < set(both.tolist())


@pytest.mark.parametrize("antithetic", [True, False])
@pytest.mark.parametrize(
    ("samples", "sampler"), [(7, "random"), (32, "sobol"), (7, "orthogonal"), (5, "orthogonal"), (19, "orthogonal")]
)
def test_every_row_belongs_to_one_independent_draw(samples: int, sampler: str, antithetic: bool) -> None:
    smoothing = S.replace(samples=samples, sampler=sampler, antithetic=antithetic)
    parts = draws(smoothing, N)
    rows = torch.cat([part.flatten() for part in parts]).sort().values
    assert torch.equal(rows, torch.arange(smoothing.evaluations(N, center=False)))
    if antithetic:
        for part in parts:
            first, second = part.chunk(2, 1)
            assert torch.equal(second, first + samples)


def test_the_variance_of_draws_is_the_textbook_formula(monkeypatch: pytest.MonkeyPatch) -> None:
    """Value of a Gaussian: each pair is one draw, so that the variance of the mean is var(pair means) / D."""
    smoothing = S.replace(proposal="gaussian", samples=9)
    f = spread(18, -1.0, 2.0).view(1, 1, 18)
    expected = f.view(2, 9).mean(0).var() / 9
    share = torch.full((1, 18), 1 / 18, dtype=torch.float64)
    stein = perturb(X[:1], smoothing, 4, True).stein
    for chunk in (1 << 22, 1):  # all draws at a time, or one
        monkeypatch.setattr("torch_zerohess.estimation.standard_error._CHUNK", chunk)
        got = stein.variance("value", f / 18, share, draws(smoothing, N), None)
        close(got.variance, expected.view(1, 1))
        close(got.degrees, torch.full((1, 1), 8.0, dtype=torch.float64))


def test_the_variance_of_optimal_sampling_is_the_textbook_formula_per_element() -> None:
    """A draw is the pair k, k + 60 of the 6 pairs of one element; its variance is var(draws) / 6."""
    smoothing, S6 = S.replace(proposal="optimal", samples=6), 6
    stein, K = perturb(X[:1], smoothing, 4, True).stein, 120
    f = spread(K, -1.0, 2.0).view(1, 1, K)
    share = torch.full((1, K), 1 / K, dtype=torch.float64)
    pairs = (f * stein.weight / 10).view(2, 10, S6).mean(0)  # ten sets: value, three slopes, six second derivatives
    expected = pairs.var(1) / S6
    for quantity, elements in (("value", expected[0]), ("gradient", expected[1:4]), ("hessian_diagonal", expected[4:])):
        got = stein.variance(quantity, f / K, share, draws(smoothing, N), None)
        close(got.variance[0, 0], elements[[0, 3, 5]] if quantity == "hessian_diagonal" else elements)  # of 00, 01, ...
        assert bool((got.degrees == 5).all())
    v = vector(1.0, -2.0, 0.5).view(1, 1, N)
    upper = torch.zeros(N, N, dtype=torch.float64)
    upper[tuple(torch.triu_indices(N, N))] = expected[4:]
    whole = upper + upper.triu(1).mT
    close(stein.variance("hessian", f / K, share, draws(smoothing, N), None).variance[0, 0], whole)
    got = stein.variance("hvp", f / K, share, draws(smoothing, N), v)
    terms = whole * v[0, 0] ** 2
    close(got.variance[0, 0], terms.sum(1))
    close(got.degrees[0, 0], 5 * terms.sum(1) ** 2 / (terms**2).sum(1))  # Welch and Satterthwaite


def test_long_totals_are_complete() -> None:
    a = spread(2 * 5000, -1.0, 1.0).view(2, 5000, 1)
    torch.testing.assert_close(total(a), a.sum(1, keepdim=True), rtol=1e-12, atol=1e-12)


def test_what_cannot_be_drawn_again_is_stored_whatever_its_size() -> None:
    assert not stored(S, 1 << 20, N)
    for sampler in ("sobol", "orthogonal"):
        assert stored(S.replace(sampler=sampler), 1 << 20, N)


@dataclass(frozen=True)
class PlainGaussian(Stein):
    """A family as a contributor would add it: weights 1, kernels of the Gaussian, perturbations always stored."""

    u: Tensor

    @classmethod
    def draw(
        cls, x: Tensor, sigma: Tensor, smoothing: zh.Smoothing, seed: int, keep: bool, center: bool = False
    ) -> tuple[Tensor, "PlainGaussian"]:
        generator = torch.Generator().manual_seed(seed)
        u = torch.randn(len(x), smoothing.samples, x.shape[1], dtype=torch.float64, generator=generator)
        u = torch.cat([u, -u], 1) if smoothing.antithetic else u
        return completed((x[:, None] + sigma * u).to(x.dtype), x, center), cls(u)

    @classmethod
    def layout(cls, smoothing: zh.Smoothing, B: int, K: int, n: int, keep: bool) -> list[Layout]:
        return [Layout((B, K, n))]

    def tensors(self) -> list[Tensor]:
        return [self.u]

    @classmethod
    def rebuild(
        cls, tensors: Sequence[Tensor], x: Tensor, sigma: Tensor, smoothing: zh.Smoothing, keep: bool
    ) -> "PlainGaussian":
        return cls(*tensors)

    def value(self, a: Tensor) -> Tensor:
        return a.sum(2)

    def gradient(self, a: Tensor) -> Tensor:
        return a @ self.u

    def hvp(self, a: Tensor, v: Tensor) -> Tensor:
        return (a * (v @ self.u.mT)) @ self.u - a.sum(2, keepdim=True) * v

    def ratio(self, d: Tensor, project: Projection) -> Tensor:
        return torch.exp(project(self.u, d[:, None])[:, 0] - 0.5 * (d * d).sum(1, keepdim=True))

    def variance(
        self,
        quantity: Quantity,
        a: Tensor,
        share: Tensor,
        draws: Sequence[Tensor],
        v: Tensor | None,
        pooled: Tensor | None = None,
    ) -> Spread:
        raise NotImplementedError


def test_a_family_is_one_class(monkeypatch: pytest.MonkeyPatch) -> None:
    """Estimates, the layer and every transform serve a new family without any other change."""
    monkeypatch.setitem(FAMILIES, "gaussian", PlainGaussian)
    truth, x, v = Exponential(vector(0.5, -0.4)), vector(0.1, 0.3), vector(1.0, -2.0)
    smoothing = zh.Smoothing(sigma=0.6, samples=4, proposal="gaussian", seed=3)
    e = zh.estimate(truth.f, x.expand(3000, 2), smoothing)
    sigma = smoothing.sigma_vector(2, x.device)
    assert deviation(e.gradient, truth.gradient(x, sigma)) < 5
    assert deviation(e.hvp(v), truth.hessian(x, sigma) @ v) < 5
    one, layer = zh.estimate(truth.f, x, smoothing), zh.BlackBox(truth.f, smoothing)
    close(torch.func.jacrev(layer)(x), one.gradient)
    close(torch.func.hessian(layer)(x) @ v, one.hvp(v))
    close(torch.func.vmap(torch.func.grad(layer))(x[None])[0], one.gradient)
    compiled, leaf = torch.compile(layer, fullgraph=True, backend="aot_eager"), x.clone().requires_grad_()
    close(torch.autograd.grad(compiled(leaf), leaf)[0], one.gradient)
    with pytest.raises(ValueError, match=FIRST_ORDER_ERROR.split("(")[0]):
        one.hessian()  # this family leaves it out
